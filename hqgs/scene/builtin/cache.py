"""A folder that keeps photos and arrays which take time to make."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path, write_json

POINTS = "points.npz"
FORMAT = 1  # raised by hand where other photos or points are made, or kept otherwise


class Kept(NamedTuple):
    """What a folder keeps."""

    photos: dict[str, NDArray[np.uint8]]  # by file name
    arrays: dict[str, Any]  # by their names in the file
    note: str


def write_kept(folder: Path, made: dict[str, Any], kept: Kept) -> None:
    """Photos and arrays first, the key with their checksums last, so that a key vouches for whole files.

    `made` says, in JSON values, what they depend on beside FORMAT.
    """
    for name, photo in kept.photos.items():
        with atomic_path(folder / name) as tmp:
            Image.fromarray(photo).save(tmp)
    with atomic_path(folder / POINTS) as tmp:
        np.savez(tmp, **kept.arrays)
    files = {name: _checksum(folder / name) for name in [*kept.photos, POINTS]}
    write_json(folder / "key.json", {"made": {"format": FORMAT, **made}, "files": files, "note": kept.note})


def read_kept(folder: Path, made: dict[str, Any], names: Sequence[str]) -> Kept | None:
    """Photos of these names and arrays, or None if anything is missing, damaged or made in another way."""
    try:
        key = json.loads((folder / "key.json").read_text(encoding="utf-8"))
        if key["made"] != {"format": FORMAT, **made} or set(key["files"]) != {*names, POINTS}:
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
