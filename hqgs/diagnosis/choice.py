"""The training photos that a scene does without: broken, empty, far too blurred, or taken twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hqgs.base.left_out import LeftOut
from hqgs.base.text import some
from hqgs.diagnosis.copies import find_copies, note_of_unlike
from hqgs.diagnosis.coverage import Sight
from hqgs.diagnosis.scene import Inspector
from hqgs.diagnosis.sharpness import Look, Sharpness, look_at_photos
from hqgs.scene.scene import Scene, View

LEAST_KEPT = 3  # photos, and at least half
OTHERS = 3  # photos that must see a point for it to be well seen
WELL_SEEN = 0.98  # of the points of a blurred photo, without it
SHARED = 0.5  # of a photo's points that another must see to be compared with it
BLACK, WHITE = 16.0, 239.0  # levels: what is called so
LEAST_BLUR = 2.0  # px, sigma of a Gaussian
UNUSUAL = 4.0  # robust standard deviations of sigma^2 over the scene


@dataclass(frozen=True)
class _Drop:
    """A photo to leave out."""

    view: View
    why: str
    evidence: str


def choose_photos(scene: Scene, inspector: Inspector | None = None) -> tuple[Scene, list[LeftOut]]:
    """The scene without training photos that teach nothing or do harm, and what was left out.

    - Broken: with values that are not finite.
    - Empty: of one colour where most photos of the same points show something, or all hidden by its mask. A
      photo with a mask is not asked for its colours.
    - Blurred: by a Gaussian of 2 px and more against the median of the photos that see at least half of its
      points, and far from the scene's spread; and three sharper photos see (nearly) each of its points.
    - Copies: the same picture as a sharper photo from the same place (less than half a pixel of parallax at
      the scene's points). What the parallax changes is excused, unless the photos show noise or JPEG: then
      each of them averages some of it away.

    At least three photos and half of them stay. `Scene.notes` says which photos nearly went and why they
    stay. Held-out views are neither looked at nor changed. `inspector`: the one of the run.
    """
    most = len(scene.train) - max(LEAST_KEPT, (len(scene.train) + 1) // 2)
    if most <= 0:
        return scene, []
    bad = [_bad_values(view) for view in scene.train]
    drops = [
        _Drop(view, "it holds NaN or Inf", f"{count} of {view.image.size} values")
        for view, count in zip(scene.train, bad, strict=True)
        if count
    ]
    notes: list[str] = []
    sound = [view for view, count in zip(scene.train, bad, strict=True) if not count]
    if sound:
        drops += _needless(sound, scene.points, notes, inspector or Inspector())
    if len(drops) > most:
        names = some([drop.view.name for drop in drops[most:]])
        notes.append(f"training photos kept so that at least half of them stay: {names}")
        drops = drops[:most]
    if not drops and not notes:
        return scene, []
    train = [view for view in scene.train if not any(view is drop.view for drop in drops)]
    left_out = [
        LeftOut(f"training photo {d.view.name}", d.why, d.evidence, memory_mb=d.view.image.nbytes / 1e6)
        for d in drops
    ]
    return replace(scene, train=train, notes=[*scene.notes, *notes]), left_out


def _bad_values(view: View) -> int:
    photos = (view.image, view.low)
    return sum(int((~np.isfinite(p)).sum()) for p in photos if p is not None and p.dtype != np.uint8)


def _needless(
    views: list[View], points: NDArray[np.float32], notes: list[str], inspector: Inspector
) -> list[_Drop]:
    """The worst first. What was nearly left out is told in `notes`."""
    looks = look_at_photos(views)
    sight = Sight(views, points)
    peers = [_peers(sight, k) for k in range(len(views))]
    empty = _empty(views, looks, peers)
    gone = set(empty)
    spectra = [look.rings for look in looks if look.rings is not None]
    sharpness = Sharpness(spectra) if spectra else None
    rank = np.zeros(len(views)) if sharpness is None else sharpness.fine()
    copies, unlike, averaged = find_copies(views, looks, sight, rank, gone, inspector)
    gone |= {twin.index for twin in copies}
    gone |= {k for k, look in enumerate(looks) if look.colour is not None}  # there is nothing to be sharp
    blurred = {} if sharpness is None else _blurred(views, sharpness, sight, peers, gone, notes)
    if kept := [twin for twin in unlike if twin.index not in blurred and twin.sharper not in blurred]:
        notes.append(note_of_unlike(views, kept, averaged))
    repeats = [
        _Drop(
            views[twin.index],
            f"it repeats {views[twin.sharper].name}, which is no less sharp",
            f"the scene's points lie within {twin.moved:.2f} px of each other in both photos, whose pixels "
            f"differ by {twin.off:.1f} levels (root mean square)",
        )
        for twin in copies
    ]
    return [*empty.values(), *blurred.values(), *repeats]


def _peers(sight: Sight, view: int) -> NDArray[np.int64]:
    """The views that see at least half of what `view` sees."""
    covered = sight.covered(view)
    return np.flatnonzero(covered.sum(1) >= max(SHARED * covered.shape[1], 1))


def _empty(
    views: Sequence[View], looks: Sequence[Look], peers: Sequence[NDArray[np.int64]]
) -> dict[int, _Drop]:
    """Photos with nothing on them, although others of the same points show something."""
    drops = {}
    full = np.array([look.colour is None for look in looks])
    for k, (view, look) in enumerate(zip(views, looks, strict=True)):
        if view.mask is not None:
            if not view.mask.any():
                drops[k] = _Drop(view, "its mask hides all of it", "0 pixels count")
            continue
        others = int(full[peers[k]].sum())
        if look.colour is None or others < OTHERS or 2 * others <= len(peers[k]):
            continue
        name = (
            "black" if look.colour.max() < BLACK else "white" if look.colour.min() > WHITE else "one colour"
        )
        evidence = (
            f"its colour is {', '.join(f'{c:.0f}' for c in look.colour)} with a standard deviation of "
            f"{look.spread:.1f} levels; {others} of {len(peers[k])} photos of its points show something"
        )
        drops[k] = _Drop(view, f"it is all {name}", evidence)
    return drops


def _blurred(
    views: Sequence[View],
    sharpness: Sharpness,
    sight: Sight,
    peers: Sequence[NDArray[np.int64]],
    gone: set[int],
    notes: list[str],
) -> dict[int, _Drop]:
    """Photos far blurrier than others of the same points, but for those in `gone`; the blurriest first."""
    sigmas: dict[int, float] = {}
    for k in range(len(views)):
        others = np.array([p for p in peers[k] if p not in gone], np.int64)
        if k not in gone and len(others) >= OTHERS:
            sigmas[k] = sharpness.extra_blur(k, others)
    if not sigmas:
        return {}
    squares = np.array([sigma * abs(sigma) for sigma in sigmas.values()])
    spread = 1.4826 * float(np.median(np.abs(squares - np.median(squares))))
    least = max(LEAST_BLUR, float(np.sqrt(UNUSUAL * spread)))
    found = sorted((k for k, sigma in sigmas.items() if sigma >= least), key=lambda k: -sigmas[k])
    sharp = np.array([k not in gone and k not in found for k in range(len(views))])
    drops, needed = {}, []
    for k in found:
        well_seen = float((sight.covered(k)[sharp].sum(0) >= OTHERS).mean())
        if well_seen < WELL_SEEN:
            needed.append(f"{views[k].name} ({sigmas[k]:.1f} px; {1 - well_seen:.0%} of its points)")
            continue
        evidence = (
            f"its spectrum is the others' after a Gaussian blur of sigma {sigmas[k]:.1f} px (left out from "
            f"{least:.1f} px); at least {OTHERS} sharper photos see {well_seen:.0%} of its points"
        )
        drops[k] = _Drop(views[k], "it is far blurrier than other photos of the same things", evidence)
    if needed:
        notes.append(
            f"blurred training photos kept, as fewer than {OTHERS} sharper ones see a part of their points: "
            + some(needed)
        )
    return drops
