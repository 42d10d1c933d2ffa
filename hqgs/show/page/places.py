"""The cameras from above, how sure each one's place is, and where to photograph next, as SVG text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from hqgs.scene.next_photos import Spot, around, loose_photos
from hqgs.scene.scene import Scene

WIDTH, HEIGHT, BORDER = 640, 420, 24  # px
DOTS = 300  # points that are drawn
INNER = 90.0  # percent of the points that the picture has room for
ARROW = 9.0  # px, of a camera
SURE, LOOSE, NEXT = "#2f7fc4", "#d0672a", "#c03030"


def places_chart(scene: Scene, spots: Sequence[Spot]) -> Markup | None:
    """A picture, with the spots to photograph next; None of photos of one place."""
    views = [*scene.train, *scene.test]
    if len(views) < 2:
        return None
    middle, plane = around(scene)
    cameras = (np.stack([view.camera.center for view in views]) - middle) @ plane.T
    points = (scene.points[:: max(1, len(scene.points) // DOTS)].astype(np.float64) - middle) @ plane.T
    near = np.linalg.norm(points, axis=1)
    points = points[near <= np.percentile(near, INNER)] if len(points) else points
    stars = np.array([(spot.at - middle) @ plane.T for spot in spots]).reshape(-1, 2)
    all_of_them = np.concatenate([cameras, points, stars])
    low, high = all_of_them.min(0), all_of_them.max(0)
    scale = min(
        (WIDTH - 2 * BORDER) / max(high[0] - low[0], 1e-9),
        (HEIGHT - 2 * BORDER) / max(high[1] - low[1], 1e-9),
    )
    if not np.isfinite(scale):
        return None
    center = (low + high) / 2

    def at(place: np.ndarray) -> tuple[float, float]:
        x, y = (place - center) * scale + np.array([WIDTH, HEIGHT]) / 2
        return round(float(x), 1), round(float(y), 1)

    named = {name for spot in spots for name in spot.photos}
    sure = {} if scene.sfm is None else scene.sfm.sure_px
    loose = loose_photos(scene)
    parts = [
        Markup('<svg viewBox="0 0 {} {}" role="img"><title>cameras from above</title>').format(WIDTH, HEIGHT)
    ]
    label = Markup('<text x="{}" y="{}" text-anchor="middle" font-size="11">{}</text>')
    dot = Markup('<circle cx="{}" cy="{}" r="1" fill="currentColor" opacity=".35"/>')
    parts += [dot.format(*at(place)) for place in points]
    for view, place in zip(views, cameras, strict=True):
        ahead = plane @ view.camera.viewmat[2, :3]
        length = float(np.linalg.norm(ahead))
        ahead = ahead / length * ARROW if length > 1e-6 else np.zeros(2)
        x, y = at(place)
        px = sure.get(view.name)
        color = LOOSE if view.name in loose else SURE
        words = view.name if px is None else f"{view.name}: sure to {px:.2f} px"
        mark = Markup(
            '<g stroke="{}"><circle cx="{}" cy="{}" r="3" fill="{}"><title>{}</title></circle>'
            '<line x1="{}" y1="{}" x2="{}" y2="{}" stroke-width="1.5"/></g>'
        )
        tip = round(x + float(ahead[0]), 1), round(y + float(ahead[1]), 1)
        parts.append(mark.format(color, x, y, color, words, x, y, *tip))
        if view.name in named:
            parts.append(label.format(x, y - 8, view.name))
    star = Markup(
        '<circle cx="{}" cy="{}" r="9" fill="none" stroke="{}" stroke-width="2"><title>{}</title></circle>'
        '<text x="{}" y="{}" text-anchor="middle" font-weight="600">{}</text>'
    )
    for number, (spot, place) in enumerate(zip(spots, stars, strict=True), 1):
        x, y = at(place)
        parts.append(star.format(x, y, NEXT, spot.told, x, y + 4, number))
    return Markup("").join([*parts, Markup("</svg>")])
