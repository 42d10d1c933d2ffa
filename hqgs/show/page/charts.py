"""The templates of pages, and their charts as SVG text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

TEMPLATES = Path(__file__).parent / "templates"


def filled(template: str, **values: Any) -> Markup:
    """A template with these values, which are escaped."""
    from jinja2 import Environment, FileSystemLoader  # here: only a page needs it

    loader = FileSystemLoader(TEMPLATES)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return Markup(environment.get_template(template).render(**values))


def line_chart(title: str, unit: str, lines: Sequence[Sequence[tuple[float, float]]], color: str) -> Markup:
    """Values against seconds of run time, as lines. Without points: the title and a sentence."""
    points = [point for line in lines for point in line]
    if not points:
        return filled("line_chart.svg.j2", title=title, lines=[])
    xs, ys = (np.array(values, float) for values in zip(*points, strict=True))
    low, high = float(ys.min()), float(ys.max())
    pad = 0.06 * (high - low) or 0.5 * abs(high) or 1.0
    low, high = max(low - pad, 0.0) if low >= 0 else low - pad, high + pad
    end = float(xs.max()) or 1.0

    def down(y: float) -> float:
        return (high - y) / (high - low)

    return filled(
        "line_chart.svg.j2",
        title=title,
        color=color,
        lines=[
            [(x / end, down(y), f"{_number(y)} {unit} after {x:.0f} s") for x, y in line] for line in lines
        ],
        rows=[(down(y), _number(y)) for y in _ticks(low, high)],
        columns=[(x / end, _number(x)) for x in _ticks(0, end)],
    )


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers between the ends."""
    step = 10.0 ** np.floor(np.log10((high - low) / 2))
    while (high - low) / step > 5:
        step *= 2 if round(step / 10 ** np.floor(np.log10(step))) in (1, 5) else 2.5
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
