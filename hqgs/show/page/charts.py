"""Small line charts as SVG text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

WIDTH, HEIGHT = 420, 220
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 26, 34  # px around the curve


def line_chart(title: str, unit: str, lines: Sequence[Sequence[tuple[float, float]]], color: str) -> Markup:
    """Values against seconds of run time, as lines. Without points: the title and a sentence."""
    points = [point for line in lines for point in line]
    parts = [Markup('<svg viewBox="0 0 {} {}" role="img"><title>{}</title>').format(WIDTH, HEIGHT, title)]
    parts.append(Markup('<text x="{}" y="16" font-weight="600">{}</text>').format(LEFT, title))
    if not points:
        middle = Markup('<text x="{}" y="{}" opacity=".7">not measured while it trained</text></svg>')
        return Markup("").join([*parts, middle.format(LEFT, HEIGHT // 2)])
    xs, ys = (np.array(values, float) for values in zip(*points, strict=True))
    low, high = float(ys.min()), float(ys.max())
    pad = 0.06 * (high - low) or 0.5 * abs(high) or 1.0
    low, high = max(low - pad, 0.0) if low >= 0 else low - pad, high + pad
    end = float(xs.max()) or 1.0

    def at(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (WIDTH - LEFT - RIGHT) * x / end
        return round(across, 1), round(TOP + (HEIGHT - TOP - BOTTOM) * (high - y) / (high - low), 1)

    for value in _ticks(low, high):
        _, y = at(0, value)
        parts.append(
            Markup(
                '<line x1="{}" x2="{}" y1="{}" y2="{}" stroke="#8884"/>'
                '<text x="{}" y="{}" text-anchor="end">{}</text>'
            ).format(LEFT, WIDTH - RIGHT, y, y, LEFT - 6, y + 4, _number(value))
        )
    for value in _ticks(0, end):
        x, _ = at(value, low)
        parts.append(
            Markup('<text x="{}" y="{}" text-anchor="middle">{}</text>').format(
                x, HEIGHT - 16, _number(value)
            )
        )
    for line in lines:
        places = " ".join(f"{x},{y}" for x, y in (at(x, y) for x, y in line))
        parts.append(
            Markup('<polyline points="{}" fill="none" stroke="{}" stroke-width="2"/>').format(places, color)
        )
    for x, y in zip(xs, ys, strict=True):
        spot = Markup('<circle cx="{}" cy="{}" r="3" fill="{}"><title>{} {} after {:.0f} s</title></circle>')
        parts.append(spot.format(*at(x, y), color, _number(y), unit, x))
    parts.append(
        Markup('<text x="{}" y="{}" text-anchor="end" opacity=".7">run time, s</text>').format(
            WIDTH - RIGHT, HEIGHT - 2
        )
    )
    return Markup("").join([*parts, Markup("</svg>")])


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers between the ends."""
    step = 10.0 ** np.floor(np.log10((high - low) / 2))
    while (high - low) / step > 5:
        step *= 2 if round(step / 10 ** np.floor(np.log10(step))) in (1, 5) else 2.5
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
