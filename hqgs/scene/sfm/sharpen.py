"""Observations moved to sub-pixel agreement by normalised patches over all photos of a point.

SIFT finds each of them alone, a pixel off where photos are noisy. A point's patch averaged over the photos
that see it is cleaner than any of them, and each photo is laid against the mean of the others (Gauss-Newton
on pixels, two unknowns). It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's
process.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.scene.constants import OUTLIER
from hqgs.scene.sfm.constants import ANGLE, CELL, GROWN, LAID, PATCH_SIDE, ROUNDS
from hqgs.scene.sfm.patches import PatchView, aligned, read_photo, widened
from hqgs.scene.sfm.tracks import Tracks, errors, read_tracks, rebuilt, usual
from hqgs.scene.sfm.weighted import weighted

Adjust = Callable[[pycolmap.Reconstruction, float, bool], None]


def sharpened(
    model: pycolmap.Reconstruction, folder: Path, adjust: Adjust, free: bool, rounds: int = ROUNDS
) -> pycolmap.Reconstruction:
    """The model after `rounds` of patches and adjustment; as it is where the patches do not fit.

    `folder` holds the photos. `adjust` gets a model, the error in px from where on it counts an error less,
    and whether the photos move or the points alone. `free`: focal lengths and distortion are adjusted, too.

    The points that most photos see, LAID in each photo, make the poses precise; the others follow them.
    """
    names, tracks = read_tracks(model)
    photos = {name: read_photo(folder / name) for name in names}
    before = usual(model)
    sides = [max(camera.width, camera.height) for camera in model.cameras.values()]
    used, fresh = _used(tracks, len(names), CELL * max(1, float(np.median(sides)) / PATCH_SIDE))
    now, some = rebuilt(model, names, tracks), tracks.chosen(used[tracks.point])
    for number in range(rounds):
        views = [PatchView(now, name, photos[name]) for name in names]
        new = np.zeros(len(some.view), bool)
        if number > 0:
            some, new = widened(views, some)
        some, sure, unlike, information = aligned(views, some, new)
        if 2 * unlike.sum() > len(names):
            return model
        keep = some.kept(sure)
        some, off = weighted(now, names, some.chosen(sure), information[keep], free)
        own = np.array([np.median([0, *off[some.view == k]]) for k in range(len(names))])
        some = some.chosen(off <= OUTLIER * np.maximum(own, np.median(off))[some.view])
    now = rebuilt(now, names, some)
    pycolmap.ObservationManager(now).filter_all_points3D(1e9, ANGLE)
    if usual(now) > GROWN * before:
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
