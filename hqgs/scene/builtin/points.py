"""The sparse points of the embedded scene: structure from motion, or points cast onto the surfaces."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.scene.builtin.shading import render_depth
from hqgs.scene.geometry import unproject
from hqgs.scene.scene import View
from hqgs.scene.sfm.run import PROGRAM, surroundings

MIN_POINTS = 200  # fewer are no basis for a reconstruction
TIME_LIMIT = 300.0  # s: for a COLMAP that hangs; a slow or busy machine is to get the same points as others


class SparsePoints(NamedTuple):
    """Points to start from."""

    points: NDArray[np.float32]  # [P, 3], world, ascending by x, y, z
    colors: NDArray[np.uint8]  # [P, 3]
    photos: NDArray[np.intp]  # [O], of each observation the number of the view
    rows: NDArray[np.intp]  # [O], and that of the point
    note: str  # for the report


def sfm_points(views: Sequence[View], time_limit: float = TIME_LIMIT, seed: int = 0) -> SparsePoints:
    """Points of the views by COLMAP.

    COLMAP (SIFT, exhaustive matching, triangulation with the known cameras) runs in its own process and is
    killed after `time_limit` seconds. Where it fails, is late or finds fewer than 200 points, they come from
    `surface_points`, and the note says why. Points are sorted by x, y, z. Raises ValueError without views.
    """
    if not views:
        raise ValueError("views must not be empty")
    with tempfile.TemporaryDirectory(prefix="hqgs-sfm-") as name:
        directory = Path(name)
        (directory / "photos").mkdir()
        for view in views:
            Image.fromarray(view.image).save(directory / "photos" / view.name, compress_level=1)
        np.savez(
            directory / "input.npz",
            photos=str(directory / "photos"),
            names=np.array([v.name for v in views]),
            sizes=np.array([(v.camera.width, v.camera.height) for v in views]),
            Ks=np.stack([v.camera.K for v in views]),
            viewmats=np.stack([v.camera.viewmat for v in views]),
        )
        program = [sys.executable, str(PROGRAM), "triangulate", name]
        try:
            done = subprocess.run(
                program,
                capture_output=True,
                stdin=subprocess.DEVNULL,
                timeout=time_limit,
                check=False,
                env=surroundings(),
            )
        except subprocess.TimeoutExpired:
            trouble = f"it took more than {time_limit:g} s"
        else:
            if done.returncode == 0:
                with np.load(directory / "points.npz", allow_pickle=False) as data:
                    points, colors, photos, rows = (data[k] for k in ("points", "colors", "photos", "rows"))
                if len(points) >= MIN_POINTS:
                    note = f"{len(points)} points by COLMAP with the known cameras"
                    return _sorted(points, colors, photos, rows, note)
                trouble = f"it found only {len(points)} points"
            else:
                last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
                trouble = f"it ended with status {done.returncode} {' '.join(last)}".strip()
    cast = surface_points(views, seed=seed)
    return cast._replace(note=f"{cast.note}, as COLMAP gave none: {trouble}")


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
    return _sorted(xyz, np.concatenate(colors), np.concatenate(photos), np.arange(count), note)


def _sorted(
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
