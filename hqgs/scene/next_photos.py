"""Where another photo would help most: gaps between cameras, loose poses, what few photos show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.constants import (
    ALONE,
    ENOUGH_SHOW,
    FEWEST_PHOTOS,
    GAP,
    LONELIER,
    LOOSE,
    LOOSER,
    NEXT_MOST,
    WIDER,
)
from hqgs.scene.faces import photo_name
from hqgs.scene.paths import focus, scene_up
from hqgs.scene.scene import Scene, View

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spot:
    """A place to photograph from."""

    at: Array  # [3], world
    told: str  # in words
    photos: tuple[str, ...]  # that the words name


def next_photos(scene: Scene) -> list[Spot]:
    """The places where another photo would help most, the most helpful first; none: nothing stands out."""
    views = sorted([*scene.train, *scene.test], key=lambda view: view.name)
    if len(views) < FEWEST_PHOTOS:
        return []
    photos = {photo_name(view.name, view.face): view for view in reversed(views)}  # of its faces one
    centers = np.stack([view.camera.center for view in views])
    return [
        *_gaps(scene, dict(sorted(photos.items()))),
        *_loose(scene, photos),
        *_alone(scene, views, centers),
    ][:NEXT_MOST]


def told_next(scene: Scene) -> list[str]:
    """That in a sentence, or nothing."""
    spots = next_photos(scene)
    return [f"photograph here next: {'; '.join(spot.told for spot in spots)}"] if spots else []


def around(scene: Scene) -> tuple[Array, Array]:
    """The point that the photos look at [3], and axes [2, 3] of the plane that is level there."""
    up = scene_up(scene)
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(up, first)]).astype(np.float64)
    return focus([view.camera for view in scene.train]), plane


def _gaps(scene: Scene, photos: dict[str, View]) -> list[Spot]:
    """Between neighbours around the middle that stand much farther apart than others do."""
    called, views = [*photos], [*photos.values()]
    centers = np.stack([view.camera.center for view in views])
    middle, plane = around(scene)
    flat = (centers - middle) @ plane.T
    angles = np.arctan2(flat[:, 1], flat[:, 0])
    order = np.argsort(angles, kind="stable")
    steps = np.degrees(np.diff(angles[order], append=angles[order[0]] + 2 * np.pi))
    # What lies behind a capture of one side is no gap.
    widest = int(np.argmax(steps))
    usual = float(np.median(steps))
    found = []
    for k in np.argsort(-steps, kind="stable").tolist():
        if steps[k] < max(GAP, WIDER * usual) or (k == widest and steps[k] > 180):
            continue
        a, b = order[k], order[(k + 1) % len(order)]
        if not views[a].face and _turn(views[a], views[b]) < steps[k] / 2:
            continue  # both look the same way: they walk by the middle, not around it
        half = angles[a] + np.radians(steps[k]) / 2
        far = np.linalg.norm(flat[[a, b]], axis=1).mean()
        height = (centers[[a, b]] - middle).mean(0)
        at = middle + far * (np.cos(half) * plane[0] + np.sin(half) * plane[1])
        at = at + height - plane.T @ (plane @ height)
        names = sorted((called[a], called[b]))
        told = f"between {names[0]} and {names[1]}, which are {steps[k]:.0f} degrees apart"
        found.append(Spot(at, told, (names[0], names[1])))
    return found


def _turn(a: View, b: View) -> float:
    """Degrees between where two photos look."""
    cosine = float(a.camera.viewmat[2, :3] @ b.camera.viewmat[2, :3])
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def loose_photos(scene: Scene) -> dict[str, float]:
    """Photos whose poses are loose, the loosest first, and what each may be off, px."""
    sure = {} if scene.sfm is None else scene.sfm.sure_px
    most = max(LOOSE, LOOSER * float(np.median([*sure.values()]))) if sure else 0.0
    return dict(sorted(((name, px) for name, px in sure.items() if px > most), key=lambda item: -item[1]))


def _loose(scene: Scene, photos: dict[str, View]) -> list[Spot]:
    """Beside them."""
    return [
        Spot(photos[name].camera.center, f"beside {name}, whose place is sure to {px:.1f} px only", (name,))
        for name, px in loose_photos(scene).items()
        if name in photos
    ]


def _alone(scene: Scene, views: list[View], centers: Array) -> list[Spot]:
    """Beside photos that show much that no third photo does."""
    if scene.seen is None or not len(scene.points):
        return []
    counts = np.zeros(len(scene.points), np.int64)
    for rows in scene.seen.values():
        counts[rows] += 1
    shares = np.array(
        [
            float((counts[scene.seen[v.name]] < ENOUGH_SHOW).mean())
            if len(scene.seen.get(v.name, ()))
            else 0.0
            for v in views
        ]
    )
    most = max(ALONE, LONELIER * float(np.median(shares)))
    found = np.flatnonzero(shares > most)
    return [
        Spot(
            centers[k],
            f"beside {views[k].name}: {shares[k]:.0%} of what it shows is in one other photo at most",
            (views[k].name,),
        )
        for k in found[np.argsort(-shares[found], kind="stable")].tolist()
    ]
