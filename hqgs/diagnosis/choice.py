"""The training photos that a scene does without: broken, empty or far too blurred."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.base.left_out import PHOTO, LeftOut
from hqgs.base.text import some
from hqgs.diagnosis.differences import PhotoSummary, Sharpness, summarised
from hqgs.scene.constants import ENOUGH_SHOW
from hqgs.scene.geometry import in_frame
from hqgs.scene.scene import Scene, View


class Sight:
    """Which views have which points in their picture, from which side. What hides a point is not known."""

    def __init__(self, views: Sequence[View], points: NDArray[np.float32]) -> None:
        """`points` [*, 3], world."""
        # of the scene's, evenly spread, that are looked for in the photos
        world = points[evenly(len(points), 600)].astype(np.float64)
        self._inside = np.stack([in_frame(view.camera, world) for view in views])  # [N, P]
        rays = world - np.stack([view.camera.center for view in views])[:, None]
        lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
        self._rays = rays / np.where(lengths > 0, lengths, 1)  # [N, P, 3]

    def covered(self, view: int) -> NDArray[np.bool_]:
        """[N, p]: which views see each of the p points that `view` sees, from the same side; itself: none."""
        seen = self._inside[view]
        turned = np.einsum("npk,pk->np", self._rays[:, seen], self._rays[view, seen])
        # between two rays to a point; beyond, it may be another side of a thing
        covered = self._inside[:, seen] & (turned >= (np.cos(np.deg2rad(45))))
        covered[view] = False
        return covered


Drop = tuple[View, LeftOut]  # a photo to leave out, and why


def choose_photos(scene: Scene) -> tuple[Scene, list[LeftOut]]:
    """The scene without training photos that teach nothing or do harm, and what was left out.

    - Broken: with values that are not finite.
    - Empty: of one colour where most photos of the same points show something, or all hidden by its mask. A
      photo with a mask is not asked for its colours.
    - Blurred: by a Gaussian of 2 px and more against the median of the photos that see at least half of its
      points, and far from the scene's spread; and three sharper photos see (nearly) each of its points.
    At least three photos and half of them stay. `Scene.notes` says which photos nearly went and why they
    stay. Held-out views are neither looked at nor changed.
    """
    most = len(scene.train) - max(3, (len(scene.train) + 1) // 2)
    if most <= 0:
        return scene, []
    photos = ([p for p in (v.image, v.low) if p is not None and p.dtype != np.uint8] for v in scene.train)
    bad = [sum(int((~np.isfinite(photo)).sum()) for photo in of_view) for of_view in photos]
    drops = [
        _drop(view, "NaN or Inf in its pixels", f"{count} of {view.image.size} values")
        for view, count in zip(scene.train, bad, strict=True)
        if count
    ]
    notes: list[str] = []
    sound = [view for view, count in zip(scene.train, bad, strict=True) if not count]
    if sound:
        drops += _needless(sound, scene.points, notes)
    if len(drops) > most:
        names = some([view.name for view, _ in drops[most:]])
        notes.append(f"these bad training photos are used, so that at least half of the photos stay: {names}")
        drops = drops[:most]
    if not drops and not notes:
        return scene, []
    train = [view for view in scene.train if not any(view is gone for gone, _ in drops)]
    return replace(scene, train=train, notes=[*scene.notes, *notes]), [why for _, why in drops]


def _drop(view: View, why: str, evidence: str) -> Drop:
    return view, LeftOut(f"{PHOTO}{view.name}", why, evidence)


def _needless(views: list[View], points: NDArray[np.float32], notes: list[str]) -> list[Drop]:
    """The worst first. What was nearly left out is told in `notes`."""
    looks = summarised(views)
    sight = Sight(views, points)
    peers = [_peers(sight, k) for k in range(len(views))]
    empty = _empty(views, looks, peers)
    gone = set(empty)
    gone |= {k for k, look in enumerate(looks) if look.colour is not None}  # there is nothing to be sharp
    spectra = [look.rings for look in looks if look.rings is not None]
    blurred = _blurred(views, Sharpness(spectra), sight, peers, gone, notes) if spectra else {}
    return [*empty.values(), *blurred.values()]


def _peers(sight: Sight, view: int) -> NDArray[np.int64]:
    """The views that see at least half of what `view` sees."""
    covered = sight.covered(view)
    # of a photo's points that another must see to be compared with it
    return np.flatnonzero(covered.sum(1) >= max(0.5 * covered.shape[1], 1))


def _empty(
    views: Sequence[View], looks: Sequence[PhotoSummary], peers: Sequence[NDArray[np.int64]]
) -> dict[int, Drop]:
    """Photos with nothing on them, although others of the same points show something."""
    drops = {}
    full = np.array([look.colour is None for look in looks])
    for k, (view, look) in enumerate(zip(views, looks, strict=True)):
        if view.mask is not None:
            if not view.mask.any():
                drops[k] = _drop(view, "covered by its mask", "0 pixels count")
            continue
        others = int(full[peers[k]].sum())
        if look.colour is None or others < ENOUGH_SHOW or 2 * others <= len(peers[k]):
            continue
        evidence = (
            f"its colour is {', '.join(f'{c:.0f}' for c in look.colour)} with a standard deviation of "
            f"{look.spread:.1f} levels; {others} of {len(peers[k])} photos of the same points show detail"
        )
        drops[k] = _drop(view, "of one colour only", evidence)
    return drops


def _blurred(
    views: Sequence[View],
    sharpness: Sharpness,
    sight: Sight,
    peers: Sequence[NDArray[np.int64]],
    gone: set[int],
    notes: list[str],
) -> dict[int, Drop]:
    """Photos far blurrier than others of the same points, but for those in `gone`; the blurriest first."""
    sigmas: dict[int, float] = {}
    for k in range(len(views)):
        others = np.array([p for p in peers[k] if p not in gone], np.int64)
        if k not in gone and len(others) >= ENOUGH_SHOW:
            sigmas[k] = sharpness.extra_blur(k, others)
    if not sigmas:
        return {}
    squares = np.array([sigma * abs(sigma) for sigma in sigmas.values()])
    spread = 1.4826 * float(np.median(np.abs(squares - np.median(squares))))
    # robust standard deviations of sigma^2 over the scene
    least = max(2.0, float(np.sqrt(4.0 * spread)))  # px, sigma of a Gaussian
    found = sorted((k for k, sigma in sigmas.items() if sigma >= least), key=lambda k: -sigmas[k])
    sharp = np.array([k not in gone and k not in found for k in range(len(views))])
    drops, needed = {}, []
    for k in found:
        well_seen = float((sight.covered(k)[sharp].sum(0) >= ENOUGH_SHOW).mean())
        if well_seen < 0.98:  # of the points of a blurred photo, without it
            needed.append(f"{views[k].name} ({sigmas[k]:.1f} px; {1 - well_seen:.0%} of its points)")
            continue
        evidence = (
            f"as blurred as other photos after a Gaussian blur of sigma {sigmas[k]:.1f} px (left out from "
            f"{least:.1f} px); at least {ENOUGH_SHOW} sharper photos see {well_seen:.0%} of its points"
        )
        drops[k] = _drop(views[k], "far blurrier than other photos of the same things", evidence)
    if needed:
        notes.append(
            f"these blurred training photos are used, as fewer than {ENOUGH_SHOW} sharper ones see some of "
            f"their points: {some(needed)}"
        )
    return drops
