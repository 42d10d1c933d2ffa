"""A folder that keeps photos and arrays which take time to make."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path, write_json
from hqgs.photos import camera, light, shake, walkers
from hqgs.scene import faces
from hqgs.scene.sfm.run import PARTS

POINTS = "points.npz"


class Kept(NamedTuple):
    """What a folder keeps."""

    photos: dict[str, NDArray[np.uint8]]  # by file name
    arrays: dict[str, Any]  # by their names in the file
    note: str


@cache
def source() -> str:
    """A digest of the code that makes the built-in scenes: what it changes must be made anew."""
    used = [*PARTS, *(Path(str(module.__file__)) for module in (camera, light, shake, walkers, faces))]
    files = [*sorted(Path(__file__).parent.glob("*.py")), *used]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def write_kept(folder: Path, made: dict[str, Any], kept: Kept) -> None:
    """Photos and arrays first, the key with their checksums last, so that a key vouches for whole files.

    `made` says, in JSON values, what they depend on beside the code.
    """
    for name, photo in kept.photos.items():
        with atomic_path(folder / name) as tmp:
            Image.fromarray(photo).save(tmp)
    with atomic_path(folder / POINTS) as tmp:
        np.savez(tmp, **kept.arrays)
    files = {name: _checksum(folder / name) for name in [*kept.photos, POINTS]}
    write_json(folder / "key.json", {"made": {"source": source(), **made}, "files": files, "note": kept.note})


def read_kept(folder: Path, made: dict[str, Any], names: Sequence[str]) -> Kept | None:
    """Photos of these names and arrays, or None if anything is missing, damaged or made in another way."""
    try:
        key = json.loads((folder / "key.json").read_text(encoding="utf-8"))
        if key["made"] != {"source": source(), **made} or set(key["files"]) != {*names, POINTS}:
            return None
        if any(_checksum(folder / name) != digest for name, digest in key["files"].items()):
            return None
        photos = {}
        for name in names:
            with Image.open(folder / name) as image:
                photos[name] = np.asarray(image)
        with np.load(folder / POINTS, allow_pickle=False) as data:
            return Kept(photos, dict(data), str(key["note"]))
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
