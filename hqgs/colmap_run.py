"""Running COLMAP in a process of its own (`sfm_program.py`), and reading what it found."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.camera import Camera
from hqgs.files import keep_folder
from hqgs.rasterize import get_num_threads

PROGRAM = Path(__file__).with_name("sfm_program.py")
LEAST_PHOTOS = 3  # of a reconstruction
LEAST_SHARE = 0.5  # of the photos must find their place in it


def run_colmap(
    directory: Path,
    photos: Path,
    names: Sequence[str],
    cameras: Sequence[Camera] | None,
    keep: Path | None = None,
) -> pycolmap.Reconstruction:
    """COLMAP's largest model of the photos `names` in the folder `photos`; `directory` gets its files.

    `cameras`: pinhole intrinsics that stay as they are; None: COLMAP finds them. `directory / "masks"`, if it
    is there, holds a mask for every photo. Models are kept in the folder `keep`: COLMAP does not run again
    for the same photos, masks, cameras and version. ValueError for fewer than 3 photos, where COLMAP fails,
    or where the photos do not match.
    """
    if len(names) < LEAST_PHOTOS:
        raise ValueError(f"structure from motion needs at least {LEAST_PHOTOS} photos, got {len(names)}")
    given: dict[str, NDArray[np.generic]] = {"names": np.array(names), "photos": np.array(str(photos))}
    if cameras is not None:
        given["sizes"] = np.array([(camera.width, camera.height) for camera in cameras])
        given["Ks"] = np.stack([camera.K for camera in cameras])
    kept = None if keep is None else keep / _key(directory / "masks", given)
    if kept is not None and kept.is_dir():
        return pycolmap.Reconstruction(kept)
    np.savez(directory / "input.npz", **given)  # pyright: ignore[reportArgumentType]
    program = [sys.executable, str(PROGRAM), "reconstruct", str(directory), str(get_num_threads())]
    done = subprocess.run(program, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    if done.returncode != 0:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise ValueError(f"COLMAP ended with status {done.returncode} {' '.join(last)}".strip())
    if not (directory / "model" / "images.bin").is_file():
        raise ValueError(
            f"COLMAP could start from no two of the {len(names)} photos: they need texture and overlap, and "
            "places to be taken from that lie apart"
        )
    if kept is not None:
        keep_folder(directory / "model", kept)
    return pycolmap.Reconstruction(directory / "model")


def _key(masks: Path, given: dict[str, NDArray[np.generic]]) -> str:
    """A name for everything that the model depends on; where the photos lie is not part of it."""
    digest = hashlib.sha256(f"{pycolmap.__version__} {sorted(given)}".encode() + PROGRAM.read_bytes())
    photos = Path(str(given["photos"]))
    for name in given["names"].tolist():
        for file in (photos / name, masks / f"{name}.png"):
            content = file.read_bytes() if file.is_file() else b""
            digest.update(f"{name} {len(content)} ".encode() + content)
    for part in ("sizes", "Ks"):
        if part in given:
            digest.update(given[part].tobytes())
    return digest.hexdigest()[:16]


def seen_points(model: pycolmap.Reconstruction) -> dict[str, NDArray[np.intp]]:
    """By photo, the rows of `model_points` that it shows, ascending; photos without a place show none.

    Points that the model lacks do not count: tools remove some and leave the photos as they are.
    """
    row = {point: k for k, point in enumerate(sorted(model.points3D))}
    return {
        image.name: np.array(
            sorted({row[p.point3D_id] for p in image.points2D if p.point3D_id in row}), dtype=np.intp
        )
        for image in model.images.values()
        if image.has_pose
    }


def registered(model: pycolmap.Reconstruction, photos: int) -> dict[str, NDArray[np.float64]]:
    """World-to-camera matrices [4, 4] by photo, sorted; ValueError where too few of the `photos` have one."""
    poses = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            poses[image.name] = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
    if len(poses) < max(LEAST_PHOTOS, LEAST_SHARE * photos):
        raise ValueError(
            f"COLMAP registered only {len(poses)} of {photos} photos, wanted at least {LEAST_PHOTOS} and "
            f"{LEAST_SHARE:.0%}; the others do not match them well enough"
        )
    return poses


def model_points(model: pycolmap.Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points [P, 3] and colours [P, 3] by ascending id: COLMAP keeps them in a hash map without an order."""
    points = [point for _, point in sorted(model.points3D.items(), key=lambda item: item[0])]
    xyz = np.array([p.xyz for p in points], np.float64).reshape(-1, 3)
    return xyz, np.array([p.color for p in points], np.uint8).reshape(-1, 3)
