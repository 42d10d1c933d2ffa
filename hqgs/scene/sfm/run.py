"""Running COLMAP in a process of its own (`program.py`), and reading what it found."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs._rust import get_num_threads
from hqgs.base.files import keep_folder
from hqgs.scene.formats.colmap import LEAST_PHOTOS
from hqgs.scene.scene import Camera

PROGRAM = Path(__file__).with_name("program.py")


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
