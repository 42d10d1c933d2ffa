"""Scenes as PLY files in the layout of 3DGS, which the common viewers read.

One vertex per Gaussian, float32: x y z, f_dc_0..2, f_rest_* (all red coefficients, then green, then blue; 0,
9, 24 or 45 of them for the SH degrees 0 to 3), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z). Readers
find columns by their names; the normals of 3DGS, which are all zero, are not written (nor does gsplat).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError

from hqgs.base.files import atomic_path
from hqgs.model.gaussians import MAX_SH_DEGREE, Gaussians

MAX_HEADER_BYTES = 1 << 16
REST_COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1)]  # 0, 9, 24, 45
MEANS = ["x", "y", "z"]
DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALES = ["scale_0", "scale_1", "scale_2"]
QUATS = ["rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path: str | Path, gaussians: Gaussians) -> int:
    """Write the Gaussians atomically, without the rows that hold a NaN or Inf; return how many those were."""
    tensors = {name: t.detach().float().numpy() for name, t in gaussians.named().items()}
    n = len(gaussians)
    # [N, K - 1, 3] to channel-major [N, 3 (K - 1)]
    rest = tensors["shN"].transpose(0, 2, 1).reshape(n, 3 * tensors["shN"].shape[1])
    columns = [
        (MEANS, tensors["means"]),
        (DC, tensors["sh0"][:, 0]),
        ([f"f_rest_{i}" for i in range(rest.shape[1])], rest),
        (["opacity"], tensors["opacities"][:, None]),
        (SCALES, tensors["scales"]),
        (QUATS, tensors["quats"]),
    ]
    names = [name for group, _ in columns for name in group]
    rows = np.concatenate([values for _, values in columns], axis=1, dtype=np.dtype("<f4"))
    finite = np.isfinite(rows).all(axis=1)
    vertices = np.ascontiguousarray(rows[finite]).view([(name, "<f4") for name in names])[:, 0]
    with atomic_path(path) as tmp:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(tmp))
    return int(n - finite.sum())


def read_ply(path: str | Path) -> Gaussians:
    """Read what `write_ply`, 3DGS or gsplat wrote.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a PLY file, not this layout, an SH degree above 3, more rows promised than the file
            can hold, or a row that is not finite. The message names the file.
    """
    path = Path(path)
    _check_header(path)
    try:
        ply = PlyData.read(str(path))
        vertices = ply["vertex"].data
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a readable PLY file: {error}") from error
    present = {name for name in vertices.dtype.names or () if vertices.dtype[name].kind in "fiu"}
    rest = [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in present))]
    missing = [n for n in [*MEANS, *DC, *rest, "opacity", *SCALES, *QUATS] if n not in present]
    if missing:
        raise ValueError(f"{path}: not a 3DGS scene, these properties are missing: {', '.join(missing)}")
    if len(rest) not in REST_COUNTS:
        raise ValueError(f"{path}: {len(rest)} f_rest_* properties, wanted one of {REST_COUNTS}")

    def columns(names: list[str]) -> np.ndarray:
        return np.stack([vertices[name].astype(np.float32) for name in names], axis=1)

    arrays = {
        "means": columns(MEANS),
        "scales": columns(SCALES),
        "quats": columns(QUATS),
        "opacities": columns(["opacity"])[:, 0],
        "sh0": columns(DC)[:, None, :],
        "shN": np.zeros((len(vertices), 0, 3), np.float32),
    }
    if rest:
        arrays["shN"] = columns(rest).reshape(len(vertices), 3, len(rest) // 3).transpose(0, 2, 1)
    for name, array in arrays.items():
        bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
        if bad.size:
            raise ValueError(f"{path}: {name} is not finite in {bad.size} rows, the first is row {bad[0]}")
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()})


def _check_header(path: Path) -> None:
    """Refuse a header that promises more than the file holds, before anything of that size is allocated."""
    with path.open("rb") as f:
        head = f.read(MAX_HEADER_BYTES)
        left = os.fstat(f.fileno()).st_size
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise ValueError(f"{path}: not a PLY file (no header that ends within {MAX_HEADER_BYTES} bytes)")
    values = 0
    count = 0
    for line in head[:end].splitlines():
        words = line.split()
        if words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit():
            count = int(words[2])
        elif words[:1] == [b"property"]:
            values += count  # a value takes at least one byte in every PLY format
        elif words[:1] == [b"element"]:
            raise ValueError(f"{path}: not a readable PLY file: {line!r}")
    if values > left:
        raise ValueError(f"{path}: the header promises {values} values, the file has {left} bytes")
