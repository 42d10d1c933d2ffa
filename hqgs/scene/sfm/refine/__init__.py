"""A model refined: observations moved to sub-pixel agreement by normalised patches, and places checked.

SIFT finds each of them alone, a pixel off where photos are noisy. A point's patch averaged over the photos
that see it is cleaner than any of them, and each photo is laid against the mean of the others (Gauss-Newton
on pixels, two unknowns).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.scene.constants import OUTLIER
from hqgs.scene.sfm.refine.agree import WEAKLY_JOINT, Agreement, agreement, confirmed, loose_parts
from hqgs.scene.sfm.refine.patches import PATCH_SIDE, PatchView, aligned, read_photos, widened
from hqgs.scene.sfm.refine.tracks import Tracks, errors, read_tracks, rebuilt, usual

ROUNDS, FEWER = 3, 2  # of patches and adjustment; where features are precise already
ALWAYS_CHECKED = 16  # photos, whose places are always checked
LAID = 400  # observations of a photo, of the points whose patches are laid
ANGLE = pycolmap.IncrementalMapperOptions().filter_min_tri_angle  # degrees between two rays to a point, least

Adjust = Callable[[pycolmap.Reconstruction, float, bool], None]


class Adjusting(Protocol):
    """How models are adjusted: what COLMAP's options of a pass are needed for."""

    def adjust(self, model: pycolmap.Reconstruction, scale: float, move: bool) -> None: ...
    def settle(self, model: pycolmap.Reconstruction) -> None: ...
    def tell(self, stage: str, done: int, total: int = 0) -> None: ...


def refined(
    plain: pycolmap.Reconstruction, folder: Path, work: Adjusting, sure: set[str], photos: int, largest: int
) -> tuple[pycolmap.Reconstruction, Agreement]:
    """The model, with observations moved to where the photos of a folder agree, where that is more precise.

    Then what photos show is compared with what they should show, where that may not be the same: the counts
    by photo. Those that are not `sure`, as weak evidence placed them, do not stay where it is not. `photos`
    in all were looked for; SIFT saw them at `largest` px at most.
    """
    work.tell("sharpen", 0)
    sides = [max(camera.width, camera.height) for camera in plain.cameras.values()]
    unsure = usual(plain) * min(1, largest / float(np.median(sides))) > 0.3  # px; photos may be bad
    model, all_sure = plain, sure >= placed_names(plain)
    for _ in range(1 if all_sure else 2):  # weaker evidence: farther off
        rounds = ROUNDS if unsure else FEWER
        model = sharpened(model, folder, work.adjust, rounds)
    if model is plain and not all_sure:
        work.settle(plain)
    whole = model.num_reg_images() == photos >= ALWAYS_CHECKED
    if whole and not unsure and not loose_parts(plain, WEAKLY_JOINT):
        return model, {}
    work.tell("agree", 0)
    rest = rebuilt(model, *read_tracks(plain))
    work.adjust(rest, usual(plain), False)
    agree = agreement(rest, folder)
    strange = {name for name, counts in agree.items() if not confirmed(*counts)} - sure
    if strange:
        without(model, strange)
        work.adjust(model, usual(model), True)
    return model, {name: counts for name, counts in agree.items() if name not in strange}


def placed_names(model: pycolmap.Reconstruction) -> set[str]:
    """The photos that have a place in a model."""
    return {model.images[k].name for k in model.reg_image_ids()}


def without(model: pycolmap.Reconstruction, names: set[str]) -> None:
    """Take these photos' places away."""
    for image in [model.images[k] for k in model.reg_image_ids()]:
        if image.name in names:
            model.deregister_frame(image.frame_id)


def sharpened(
    model: pycolmap.Reconstruction, folder: Path, adjust: Adjust, rounds: int = ROUNDS
) -> pycolmap.Reconstruction:
    """The model after `rounds` of patches and adjustment; as it is where the patches do not fit.

    `folder` holds the photos. `adjust` gets a model, the error in px from where on it counts an error less,
    and whether the photos move or the points alone.

    The points that most photos see, LAID in each photo, make the poses precise; the others follow them.
    """
    names, tracks = read_tracks(model)
    photos = dict(zip(names, read_photos(folder, names), strict=True))
    before = usual(model)
    sides = [max(camera.width, camera.height) for camera in model.cameras.values()]
    # points nearer than 2 px are the same
    used, fresh = _used(tracks, len(names), 2 * max(1, float(np.median(sides)) / PATCH_SIDE))
    now, some = rebuilt(model, names, tracks), tracks.chosen(used[tracks.point])
    for number in range(rounds):
        views = [PatchView(now, name, photos[name]) for name in names]
        new = np.zeros(len(some.view), bool)
        if number > 0:
            some, new = widened(views, some)
        some, sure, unlike = aligned(views, some, new)
        if 2 * unlike.sum() > len(names):
            return model
        now = rebuilt(now, names, some.chosen(sure))
        adjust(now, 2 * float(np.median(errors(now))), True)
        (_, some), off = read_tracks(now), errors(now)
        own = np.array([np.median([0, *off[some.view == k]]) for k in range(len(names))])
        some = some.chosen(off <= OUTLIER * np.maximum(own, np.median(off))[some.view])
    now = rebuilt(now, names, some)
    pycolmap.ObservationManager(now).filter_all_points3D(1e9, ANGLE)
    if usual(now) > 1.3 * before:  # these photos do not bear out the patches
        return model
    return _joined(now, names, tracks.chosen((fresh & ~used)[tracks.point]), adjust, OUTLIER * before)


def _used(tracks: Tracks, photos: int, cell: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The points [P] whose patches are laid: those with the longest tracks, until each photo has LAID.

    Also returns which points are new [P]; versions of a photo, and features with two directions, show the
    same thing again, within a cell of so many px in most of its photos.
    """
    length = np.bincount(tracks.point, minlength=len(tracks.points))
    cells = np.floor(tracks.xy / cell).astype(np.int64)
    places = list(zip(tracks.view.tolist(), *cells.T.tolist(), strict=True))
    rows = np.split(np.argsort(tracks.point, kind="stable"), np.cumsum(length)[:-1])
    taken: set[tuple[int, int, int]] = set()
    has, used, fresh = np.zeros(photos, np.int64), np.zeros(len(length), bool), np.zeros(len(length), bool)
    for point in np.argsort(-length, kind="stable"):
        here = [places[row] for row in rows[point]]
        if 2 * sum(place in taken for place in here) > len(here):
            continue
        taken.update(here)
        fresh[point] = True
        views = tracks.view[rows[point]]
        if (has[views] < LAID).any():
            used[point] = True
            has[views] += 1
    return used, fresh


def _joined(
    model: pycolmap.Reconstruction, names: list[str], others: Tracks, adjust: Adjust, far: float
) -> pycolmap.Reconstruction:
    """The model, and the points that were not used where its cameras see them."""
    _, own = read_tracks(model)
    if len(others.points):
        rest = rebuilt(model, names, others)
        adjust(rest, usual(model), False)
        _, moved = read_tracks(rest)
        own = own.joined(moved.chosen(errors(rest) <= far))
    made = rebuilt(model, names, own)
    pycolmap.ObservationManager(made).filter_all_points3D(1e9, ANGLE)
    made.update_point_3d_errors()
    return made
