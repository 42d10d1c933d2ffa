"""The templates of pages, and their charts as SVG text: lines, and the cameras from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from hqgs.scene.faces import photo_name
from hqgs.scene.paths import focus, scene_up
from hqgs.scene.scene import Scene

TEMPLATES = Path(__file__).parent / "templates"
LOOSE, LOOSER = 0.5, 3.0  # px that a pose may be off, and times the usual: a loose one


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


def places_chart(scene: Scene) -> Markup | None:
    """The cameras from above, and how sure each one's place is; None of photos of one place."""
    width, height, border = 640, 420, 24  # px, as the template has them
    views = [*scene.train, *scene.test]
    if len(views) < 2:
        return None
    up = scene_up(scene)
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    middle = focus([view.camera for view in scene.train])
    cameras = (np.stack([view.camera.center for view in views]) - middle) @ plane.T
    points = (scene.points[:: max(1, len(scene.points) // 300)].astype(np.float64) - middle) @ plane.T
    near = np.linalg.norm(points, axis=1)
    points = points[near <= np.percentile(near, 90)] if len(points) else points
    all_of_them = np.concatenate([cameras, points])
    low, high = all_of_them.min(0), all_of_them.max(0)
    scale = min(
        (width - 2 * border) / max(high[0] - low[0], 1e-9),
        (height - 2 * border) / max(high[1] - low[1], 1e-9),
    )
    if not np.isfinite(scale):
        return None
    center = (low + high) / 2

    def at(place: np.ndarray) -> tuple[float, float]:
        x, y = (place - center) * scale + np.array([width, height]) / 2
        return round(float(x), 1), round(float(y), 1)

    sure = {} if scene.sfm is None else scene.sfm.sure_px
    most = max(LOOSE, LOOSER * float(np.median([*sure.values()]))) if sure else 0.0
    shown = []
    for view, place in zip(views, cameras, strict=True):
        ahead = plane @ view.camera.viewmat[2, :3]
        length = float(np.linalg.norm(ahead))
        ahead = ahead / length * 9 if length > 1e-6 else np.zeros(2)
        px = sure.get(photo_name(view.name, view.face))
        words = view.name if px is None else f"{view.name}: exact to {px:.2f} px"
        shown.append((*at(place), *at(place + ahead / scale), px is not None and px > most, words))
    return filled("places.svg.j2", points=[*map(at, points)], cameras=shown)
