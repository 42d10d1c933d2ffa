"""Points of a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
from numpy.typing import NDArray


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points [P, 3] and colours [P, 3] of the PLY's `vertex` element; grey where it has no red, green, blue.

    Raises ValueError that names the file.
    """
    _check_header(path)
    try:
        vertex = plyfile.PlyData.read(path)["vertex"].data
        points = np.stack([vertex[k].astype(np.float64) for k in ("x", "y", "z")], -1)
        colors = np.full((len(points), 3), 128, np.uint8)
        if {"red", "green", "blue"} <= set(vertex.dtype.names or ()):
            colors = np.stack([vertex[k] for k in ("red", "green", "blue")], -1)
            if colors.dtype.kind == "f":
                colors = np.rint(np.nan_to_num(colors) * 255)
            colors = colors.clip(0, 255).astype(np.uint8)
    except (plyfile.PlyParseError, ValueError, KeyError, TypeError, OverflowError) as e:
        raise ValueError(f"cannot read the points in {path}: {e}") from e
    return points, colors


def _check_header(path: Path) -> None:
    """Refuse a PLY whose header promises more values than it has bytes, before memory is taken for them."""
    size = path.stat().st_size
    promised = count = 0
    with path.open("rb") as f:
        for line in iter(lambda: f.readline(4096), b""):
            words = line.split()
            if words[:1] == [b"end_header"]:
                return
            if words[:1] == [b"element"]:
                if len(words) != 3 or not words[2].isdigit():
                    raise ValueError(f"{path}: a PLY header has no line {line[:80]!r}")
                count = int(words[2])
            elif words[:1] == [b"property"]:
                promised += count
            if max(promised, count) > size:
                raise ValueError(
                    f"{path} is damaged: its header promises {count} records, it has {size} bytes"
                )
    raise ValueError(f"{path} is no PLY file: its header does not end")
