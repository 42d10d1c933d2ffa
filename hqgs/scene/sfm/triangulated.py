"""Points for cameras and poses that are known, by COLMAP in a process of its own."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.distance import cdist

from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.scene import View
from hqgs.scene.sfm.likely import MATCHED_ALL, PARTNERS
from hqgs.scene.sfm.run import run_program

ALIKE = 0.5  # cosine of the angle between the directions in which two photos of more must look, at least
POINTS_WANTED, TRIANGULATION = 200, 1800.0  # below which there is no basis; s for a COLMAP that hangs


class SparsePoints(NamedTuple):
    """Points to start from."""

    points: NDArray[np.float32]  # [P, 3], world, ascending by x, y, z
    colors: NDArray[np.uint8]  # [P, 3]
    photos: NDArray[np.intp]  # [O], of each observation the number of the view
    rows: NDArray[np.intp]  # [O], and that of the point
    note: str  # for the report


def triangulated(views: Sequence[View], time_limit: float = TRIANGULATION) -> SparsePoints | str:
    """Points of the views, or why there are none: SIFT, matching, triangulation.

    Of many views each is matched with those near it that look its way. COLMAP is killed after `time_limit`
    seconds. Same photos, same points.
    """
    with tempfile.TemporaryDirectory(prefix="hqgs-sfm-") as name:
        directory = Path(name)
        names = [f"{k:06d}.png" for k in range(len(views))]
        (directory / "photos").mkdir()
        write_photos(directory / "photos", dict(zip(names, views, strict=True)))
        cameras = [view.camera for view in views]
        given = {
            "photos": np.array(str(directory / "photos")),
            "names": np.array(names),
            "sizes": np.array([(camera.width, camera.height) for camera in cameras]),
            "Ks": np.stack([camera.K for camera in cameras]),
            "viewmats": np.stack([camera.viewmat for camera in cameras]),
        }
        if len(views) > MATCHED_ALL:
            given["pairs"] = pairs_of(views)
        np.savez(directory / "input.npz", allow_pickle=False, **given)
        try:
            run_program("triangulate", directory, time_limit=time_limit)
        except ValueError as error:
            return str(error)
        with np.load(directory / "points.npz", allow_pickle=False) as data:
            points, colors, photos, rows = (data[k] for k in ("points", "colors", "photos", "rows"))
    if len(points) < POINTS_WANTED:
        return f"it found only {len(points)} points"
    return in_order(points, colors, photos, rows, f"{len(points)} points by COLMAP with the known cameras")


def write_photos(folder: Path, views: Mapping[str, View]) -> None:
    """The photos as PNG files of those names, and masks in `masks` beside the folder where a view has one."""
    masks = folder.with_name("masks")
    if masked := any(view.mask is not None for view in views.values()):
        masks.mkdir()
    for file, view in views.items():
        Image.fromarray(to_uint8(as_floats(view.image))).save(folder / file, compress_level=1)
        if masked:
            counts = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask
            Image.fromarray(counts.astype(np.uint8) * 255).save(masks / f"{file}.png")


def pairs_of(views: Sequence[View]) -> NDArray[np.intp]:
    """Numbers [P, 2] of views that are to be matched: each with PARTNERS, the nearest that look its way."""
    centers = np.stack([view.camera.center for view in views])
    axes = np.stack([view.camera.viewmat[2, :3] for view in views])
    apart = np.where(axes @ axes.T > ALIKE, cdist(centers, centers), np.inf)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1, kind="stable")[:, :PARTNERS]
    own = np.repeat(np.arange(len(views)), near.shape[1]).reshape(near.shape)
    found = np.stack([own, near], -1)[np.isfinite(np.take_along_axis(apart, near, 1))]
    return np.unique(np.sort(found, 1), axis=0)


def in_order(
    points: NDArray[np.float32],
    colors: NDArray[np.uint8],
    photos: NDArray[np.intp],
    rows: NDArray[np.intp],
    note: str,
) -> SparsePoints:
    """In ascending order of x, then y, then z."""
    order = np.lexsort(points.T[::-1])
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return SparsePoints(points[order], colors[order], photos, place[rows], note)
