"""The cameras from above, how sure each one's place is, and where to photograph next, as SVG text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from hqgs.scene.faces import photo_name
from hqgs.scene.next_photos import Spot, around, loose_photos
from hqgs.scene.scene import Scene
from hqgs.show.page.filled import filled

WIDTH, HEIGHT, BORDER = 640, 420, 24  # px, as its template has them
DOTS = 300  # points that are drawn
INNER = 90.0  # percent of the points that the picture has room for
ARROW = 9.0  # px, of a camera


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
    loose, shown = loose_photos(scene), []
    for view, place in zip(views, cameras, strict=True):
        ahead = plane @ view.camera.viewmat[2, :3]
        length = float(np.linalg.norm(ahead))
        ahead = ahead / length * ARROW if length > 1e-6 else np.zeros(2)
        photo = photo_name(view.name, view.face)
        px = sure.get(photo)
        words = view.name if px is None else f"{view.name}: sure to {px:.2f} px"
        name = next((name for name in (view.name, photo) if name in named), "")
        shown.append((*at(place), *at(place + ahead / scale), photo in loose, words, name))
    told = [(*at(place), spot.told) for spot, place in zip(spots, stars, strict=True)]
    return filled("places.svg.j2", points=[*map(at, points)], cameras=shown, spots=told)
