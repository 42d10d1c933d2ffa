"""The sparse points of the embedded scene: structure from motion, or points cast onto the surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hqgs.scene.builtin.shading import render_depth
from hqgs.scene.geometry import unproject
from hqgs.scene.scene import View
from hqgs.scene.sfm.constants import TRIANGULATION
from hqgs.scene.sfm.triangulated import SparsePoints, in_order, triangulated


def sfm_points(views: Sequence[View], time_limit: float = TRIANGULATION) -> SparsePoints:
    """Points of the views by COLMAP.

    COLMAP (SIFT, exhaustive matching, triangulation with the known cameras) runs in its own process and is
    killed after `time_limit` seconds. Where it fails, is late or finds fewer than 200 points, they come from
    `surface_points`, and the note says why. Points are sorted by x, y, z. Raises ValueError without views.
    """
    if not views:
        raise ValueError("views must not be empty")
    found = triangulated(views, time_limit)
    if isinstance(found, SparsePoints):
        return found
    cast = surface_points(views)
    return cast._replace(note=f"{cast.note}, as COLMAP gave none: {found}")


def surface_points(
    views: Sequence[View], count: int = 4000, noise: float = 0.005, seed: int = 0
) -> SparsePoints:
    """`count` points under random pixels of photos of the embedded scene, each seen by its own photo.

    The depth is off by a normal error of standard deviation `noise` times the depth.
    """
    rng = np.random.default_rng(seed)
    points, colors, photos = [], [], []
    for number, (view, share) in enumerate(
        zip(views, np.array_split(np.arange(count), len(views)), strict=True)
    ):
        camera = view.camera
        depth = render_depth(camera)
        rows, cols = np.nonzero(np.isfinite(depth))
        pick = rng.integers(0, len(rows), len(share))
        i, j = rows[pick], cols[pick]
        z = depth[i, j] * (1 + noise * rng.standard_normal(len(pick)))
        points.append(unproject(camera, np.stack([j, i], 1).astype(np.float64) + 0.5, z))
        colors.append(view.image[i, j])
        photos.append(np.full(len(pick), number, np.intp))
    xyz = np.concatenate(points).astype(np.float32)
    note = f"{count} points cast onto the surfaces"
    return in_order(xyz, np.concatenate(colors), np.concatenate(photos), np.arange(count), note)
