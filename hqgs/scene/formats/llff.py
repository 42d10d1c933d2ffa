"""LLFF folders: poses_bounds.npy with photos; the Deblur-NeRF marker hold=N."""

from __future__ import annotations

import re
import tokenize
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.scene.capture import Capture, Photo, list_photos, no_points, photo_folder, viewmat_from_pose
from hqgs.scene.constants import LARGEST, MOST_SIDE
from hqgs.scene.masks import masks_of

POSES = "poses_bounds.npy"


def read_llff(root: Path, downscale: float) -> Capture:
    """Read cameras and depth bounds from `poses_bounds.npy` [N, 17]: 3 x 5 pose and size, then near and far.

    The pose's columns are the camera's down, right and back axes and its centre in the world; the fifth is
    (height, width, focal length) of the full-size photos (Mildenhall et al. 2019, LLFF's read-me). The
    principal point is the middle. Photos belong to the rows in the order of their names.
    """
    found = photo_folder(root, downscale)
    if found is None:
        raise ValueError(f"{root} has {POSES} but no photos: looked for images, images_{downscale:g}")
    folder, left, notes = found
    rows = _read_rows(root / POSES)
    names = list_photos(folder)
    if len(names) != len(rows):
        raise ValueError(f"{root / POSES} has {len(rows)} cameras, {folder} has {len(names)} photos")
    masks = masks_of(root, folder, names)
    photos, near_far = [], {}
    for name, row in zip(names, rows, strict=True):
        pose, (height, width, focal) = row[:15].reshape(3, 5)[:, :4], row[[4, 9, 14]]
        near, far = (float(b) for b in row[15:])
        down, right, back, center = pose.T
        opencv = np.stack([right, down, -back, center], -1)
        if not (1 <= height <= MOST_SIDE and 1 <= width <= MOST_SIDE and 0 < focal < np.inf):
            raise ValueError(f"{root / POSES}: photo {name!r} has h, w, f = {height}, {width}, {focal}")
        if not (0 < near < far < LARGEST):
            raise ValueError(f"{root / POSES}: photo {name!r} has the depth bounds {near}, {far}")
        camera = pycolmap.Camera(
            model="PINHOLE",
            width=round(width),
            height=round(height),
            params=[focal, focal, width / 2, height / 2],
        )
        viewmat = viewmat_from_pose(opencv, name, camera_to_world=True)
        photos.append(Photo(name, folder / name, camera, viewmat, masks.get(name)))
        near_far[name] = (near, far)
    notes.append(f"cameras from {POSES}: there is no COLMAP model with photos")
    return Capture("llff", photos, left, *no_points(), folder=folder, near_far=near_far, notes=notes)


def hold_marker(root: Path) -> int | None:
    """N of a file named `hold=N`: every N-th photo is the sharp, held-out one. None without such a file."""
    markers = sorted(p.name for p in root.iterdir() if p.name.startswith("hold="))
    if not markers:
        return None
    match = re.fullmatch(r"hold=([1-9][0-9]{0,5})", markers[0])
    if len(markers) > 1 or match is None:
        raise ValueError(f"{root}: expected one marker file hold=N with N >= 1, found {markers}")
    return int(match[1])


def _read_rows(path: Path) -> NDArray[np.float64]:
    try:
        # Mapped, not read: the header's shape is then held against the file's size before memory is taken.
        rows = np.lib.format.open_memmap(path, mode="r")
    except (ValueError, OSError, TypeError, OverflowError, SyntaxError, tokenize.TokenError) as e:
        raise ValueError(f"cannot read {path}: {e}") from e
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0 or rows.dtype.kind != "f":
        raise ValueError(f"{path}: expected floats of shape [N, 17], got {rows.dtype} {list(rows.shape)}")
    return np.array(rows, np.float64)
