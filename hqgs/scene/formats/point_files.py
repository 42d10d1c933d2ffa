"""Points in files that hold nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.base.ply import read_vertices


def read_ply_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points [P, 3] and colours [P, 3] of the PLY's `vertex` element; grey where it has no red, green, blue.

    Raises ValueError that names the file.
    """
    vertex = read_vertices(path)
    try:
        points = np.stack([vertex[k].astype(np.float64) for k in ("x", "y", "z")], -1)
        colors = np.full((len(points), 3), 128, np.uint8)
        if {"red", "green", "blue"} <= set(vertex.dtype.names or ()):
            colors = np.stack([vertex[k] for k in ("red", "green", "blue")], -1)
            if colors.dtype.kind == "f":
                colors = np.rint(np.nan_to_num(colors) * 255)
            colors = colors.clip(0, 255).astype(np.uint8)
    except (ValueError, KeyError, TypeError, OverflowError) as e:
        raise ValueError(f"cannot read the points in {path}: {e}") from e
    return points, colors
