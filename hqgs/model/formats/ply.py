"""PLY files in the layout of 3DGS, which the common viewers read.

One vertex per Gaussian, float32: x y z, f_dc_0..2, f_rest_* (all red coefficients, then green, then blue; 0,
9, 24 or 45 of them for the SH degrees 0 to 3), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z). Readers
find columns by their names; the normals of 3DGS, which are all zero, are not written (nor does gsplat).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from hqgs.base.files import atomic_path
from hqgs.base.ply import read_vertices
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.model.formats.arrays import Arrays

_REST_COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1)]  # 0, 9, 24, 45
_MEANS = ["x", "y", "z"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path: str | Path, arrays: Arrays) -> int:
    """Write Gaussians atomically, without the rows that hold a NaN or Inf; return how many those were."""
    n, higher = arrays["shN"].shape[:2]
    # [N, K - 1, 3] to channel-major [N, 3 (K - 1)]
    rest = arrays["shN"].transpose(0, 2, 1).reshape(n, 3 * higher)
    columns = [
        (_MEANS, arrays["means"]),
        (_DC, arrays["sh0"][:, 0]),
        ([f"f_rest_{i}" for i in range(rest.shape[1])], rest),
        (["opacity"], arrays["opacities"][:, None]),
        (_SCALES, arrays["scales"]),
        (_QUATS, arrays["quats"]),
    ]
    names = [name for group, _ in columns for name in group]
    with np.errstate(over="ignore"):  # of float64: such a row is left out
        rows = np.concatenate([values for _, values in columns], axis=1, dtype=np.dtype("<f4"))
    finite = np.isfinite(rows).all(axis=1)
    vertices = np.ascontiguousarray(rows[finite]).view([(name, "<f4") for name in names])[:, 0]
    with atomic_path(path) as tmp:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(tmp))
    return int(n - finite.sum())


def read_ply(path: str | Path) -> Arrays:
    """Read the Gaussians that hqgs, 3DGS, gsplat or Brush wrote: float32 arrays.

    Properties are found by name, in any order, as numbers of any kind; others are passed by. Text files and
    binary ones of either byte order are read.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a PLY file, not this layout, an SH degree above 3, more rows promised than the file
            can hold, or a value that is not finite. The message names the file and the property.
    """
    vertices = read_vertices(path)
    present = {name for name in vertices.dtype.names or () if vertices.dtype[name].kind in "fiu"}
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in present))]
    missing = [n for n in [*_MEANS, *_DC, *rest, "opacity", *_SCALES, *_QUATS] if n not in present]
    if missing:
        raise ValueError(f"{path}: not a 3DGS scene, these properties are missing: {', '.join(missing)}")
    if len(rest) not in _REST_COUNTS:
        raise ValueError(f"{path}: {len(rest)} f_rest_* properties, wanted one of {_REST_COUNTS}")

    def columns(names: list[str]) -> NDArray[np.float32]:
        found = np.empty((len(vertices), len(names)), np.float32)
        for k, name in enumerate(names):
            with np.errstate(over="ignore"):  # of float64
                found[:, k] = vertices[name]
            bad = np.flatnonzero(~np.isfinite(found[:, k]))
            if bad.size:
                raise ValueError(
                    f"{path}: {name} is not finite in {bad.size} rows, the first is row {bad[0]}"
                )
        return found

    higher = columns(rest).reshape(len(vertices), 3, len(rest) // 3).transpose(0, 2, 1)
    return {
        "means": columns(_MEANS),
        "scales": columns(_SCALES),
        "quats": columns(_QUATS),
        "opacities": columns(["opacity"])[:, 0],
        "sh0": columns(_DC)[:, None, :],
        "shN": np.ascontiguousarray(higher),
    }
