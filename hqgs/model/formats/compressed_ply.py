"""Compressed PLY files, as SuperSplat writes them: 16 bytes a Gaussian and a byte for each harmonic.

Chunks of 256 Gaussians hold the bounds of their positions, log scales and colours; each Gaussian is four
words of 32 bits, which say where between those bounds it is:

| word | bits | error at most |
|---|---|---|
| packed_position | x 11, y 10, z 11 | half of 1/2047 (y: 1/1023) of the chunk's box |
| packed_rotation | place of the largest component 2, the others 10 each | 0.003 rad |
| packed_scale | 11, 10, 11 | as positions, of the range of logs, which ends at -20 and 20 |
| packed_color | red, green, blue, opacity, 8 each | half of 1/255 of the chunk's colours; opacity 0.5/255 |

A harmonic is one byte, from -4 to 4 in 256 steps: an error of 1/64.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from hqgs.base.files import atomic_path
from hqgs.base.ply import MAX_HEADER_BYTES, read_elements
from hqgs.model.constants import MAX_SH_DEGREE, SH_C0
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.rows import (
    curve_order,
    finite_rows,
    of_smallest_three,
    pick,
    smallest_three,
    to_logits,
    to_opacities,
)

CHUNK = 256
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_PARTS = (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
BOUNDS = [f"{end}_{kind}{axis}" for kind, axes in _PARTS for end in ("min", "max") for axis in axes]
LOG_LIMIT = 20.0
SPREAD = np.sqrt(0.5)  # a component that is not the largest is no larger
_COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1)]
_BITS, _TURN_BITS = (11, 10, 11), (10, 10, 10)  # above those of a rotation: which component is left out


def write_compressed_ply(path: str | Path, arrays: Arrays) -> int:
    """Write atomically along a curve through space, without rows that hold NaN or Inf; return how many."""
    finite = finite_rows(arrays)
    g = pick(arrays, finite)
    g = pick(g, curve_order(g["means"]))
    n = len(g["means"])
    colors = 0.5 + SH_C0 * g["sh0"][:, 0].astype(np.float64)
    logs = g["scales"].astype(np.float64).clip(-LOG_LIMIT, LOG_LIMIT)
    starts, chunk = np.arange(0, n, CHUNK), np.arange(n) // CHUNK
    chunks = np.zeros(len(starts), [(name, "<f4") for name in BOUNDS])
    words = np.zeros(n, [(name, "<u4") for name in WORDS])
    shares = []
    for k, values in enumerate((g["means"].astype(np.float64), logs, colors)):
        names = BOUNDS[6 * k : 6 * k + 6]
        low = np.minimum.reduceat(values, starts).astype("<f4") if n else values
        high = np.maximum.reduceat(values, starts).astype("<f4") if n else values
        for axis in range(3):
            chunks[names[axis]], chunks[names[3 + axis]] = low[:, axis], high[:, axis]
        span = np.maximum(high.astype(np.float64) - low, 1e-30)
        shares.append(((values - low[chunk]) / span[chunk]).clip(0, 1))
    words["packed_position"] = _pack(shares[0], _BITS)
    words["packed_scale"] = _pack(shares[1], _BITS)
    alphas = to_opacities(g["opacities"])[:, None]
    words["packed_color"] = _pack(np.concatenate([shares[2], alphas], axis=1), (8, 8, 8, 8))
    place, three = smallest_three(g["quats"].astype(np.float64))
    turns = _pack((three / SPREAD * 0.5 + 0.5).clip(0, 1), _TURN_BITS)
    words["packed_rotation"] = place.astype(np.uint32) << np.uint32(sum(_TURN_BITS)) | turns
    elements = [PlyElement.describe(chunks, "chunk"), PlyElement.describe(words, "vertex")]
    if count := 3 * g["shN"].shape[1]:
        rest = g["shN"].astype(np.float64).transpose(0, 2, 1).reshape(n, count)
        levels = np.floor((rest / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8)
        names = [(f"f_rest_{k}", "u1") for k in range(count)]
        elements.append(PlyElement.describe(np.ascontiguousarray(levels).view(names)[:, 0], "sh"))
    with atomic_path(path) as tmp:
        PlyData(elements, byte_order="<").write(str(tmp))
    return int(len(finite) - n)


def is_compressed_ply(path: str | Path) -> bool:
    """Whether the header of a PLY file says so."""
    with Path(path).open("rb") as file:
        return b"packed_position" in file.read(MAX_HEADER_BYTES).partition(b"end_header")[0]


def read_compressed_ply(path: str | Path) -> Arrays:
    """Read such a file: float32 arrays.

    Raises FileNotFoundError, or ValueError that names the file where it is damaged.
    """
    path = Path(path)
    elements = read_elements(path)
    if "vertex" not in elements or "chunk" not in elements:
        raise ValueError(f"{path}: a compressed PLY file has the elements chunk and vertex")
    vertices, chunks = elements["vertex"], elements["chunk"]
    n = len(vertices)
    words = _columns(path, vertices, WORDS, "u").astype(np.uint32)
    colored = "min_r" in (chunks.dtype.names or ())
    bounds = _columns(path, chunks, BOUNDS if colored else BOUNDS[:12], "f").astype(np.float64)
    if len(bounds) * CHUNK < n:
        raise ValueError(f"{path}: {len(bounds)} chunks of {CHUNK} are too few for {n:,} Gaussians")
    if not np.isfinite(bounds).all():
        raise ValueError(f"{path}: a bound of a chunk is not finite")
    if not colored:
        bounds = np.concatenate([bounds, np.tile([0.0] * 3 + [1.0] * 3, (len(bounds), 1))], axis=1)
    own = bounds[np.arange(n) // CHUNK].reshape(n, 3, 2, 3)

    def between(shares: NDArray[np.float64], k: int) -> NDArray[np.float64]:
        return own[:, k, 0] * (1 - shares) + own[:, k, 1] * shares

    color = _unpack(words[:, 3], (8, 8, 8, 8))
    three = (_unpack(words[:, 1], _TURN_BITS) - 0.5) * 2 * SPREAD
    with np.errstate(over="ignore", invalid="ignore"):
        means = between(_unpack(words[:, 0], _BITS), 0).astype(np.float32)
        scales = between(_unpack(words[:, 2], _BITS), 1).astype(np.float32)
        sh0 = ((between(color[:, :3], 2) - 0.5) / SH_C0).astype(np.float32)
    for name, values in (("positions", means), ("scales", scales), ("colours", sh0)):
        if not np.isfinite(values).all():
            raise ValueError(f"{path}: {name} out of the range of float32")
    return {
        "means": means,
        "scales": scales,
        "quats": of_smallest_three(words[:, 1] >> np.uint32(sum(_TURN_BITS)), three).astype(np.float32),
        "opacities": to_logits(color[:, 3], 1 / 255),
        "sh0": sh0[:, None],
        "shN": _harmonics(path, elements.get("sh"), n),
    }


def _harmonics(path: Path, rows: NDArray[Any] | None, n: int) -> NDArray[np.float32]:
    if rows is None:
        return np.zeros((n, 0, 3), np.float32)
    names = [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    if len(names) not in _COUNTS or len(rows) != n:
        raise ValueError(
            f"{path}: {len(rows):,} rows of {len(names)} harmonics, wanted {n:,} of one of {_COUNTS}"
        )
    levels = _columns(path, rows, [f"f_rest_{k}" for k in range(len(names))], "u").astype(np.float64)
    values = ((levels + 0.5) / 256 - 0.5) * 8
    return np.ascontiguousarray(values.reshape(n, 3, len(names) // 3).transpose(0, 2, 1).astype(np.float32))


def _columns(path: Path, rows: NDArray[Any], names: Any, kind: str) -> NDArray[Any]:
    present = rows.dtype.names or ()
    missing = [name for name in names if name not in present or rows.dtype[name].kind != kind]
    if missing:
        raise ValueError(f"{path}: these properties are missing or of another type: {', '.join(missing)}")
    return np.stack([rows[name] for name in names], axis=1) if names else np.zeros((len(rows), 0))


def _pack(shares: NDArray[np.float64], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Numbers 0..1 [n, len(bits)] in one word, the first in the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for k, width in enumerate(bits):
        word = word << np.uint32(width) | np.rint(shares[:, k] * ((1 << width) - 1)).astype(np.uint32)
    return word


def _unpack(word: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float64]:
    shares, shift = [], sum(bits)
    for width in bits:
        shift -= width
        most = (1 << width) - 1
        shares.append((word >> np.uint32(shift) & np.uint32(most)) / most)
    return np.stack(shares, axis=1)
