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
from hqgs.base.ply import header_of, read_elements
from hqgs.model.constants import MAX_SH_DEGREE
from hqgs.model.formats.arrays import (
    Arrays,
    of_colors,
    of_smallest_three,
    shown,
    smallest_three,
    to_logits,
    to_opacities,
    writable,
)
from hqgs.model.formats.ply_comments import comments_of, told_by
from hqgs.scene.world import World

CHUNK = 256
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_PARTS = (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
BOUNDS = [f"{end}_{kind}{axis}" for kind, axes in _PARTS for end in ("min", "max") for axis in axes]
LOG_LIMIT = 20.0
SPREAD = np.sqrt(0.5)  # a component that is not the largest is no larger
_COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1)]
_BITS, _TURN_BITS = (11, 10, 11), (10, 10, 10)  # above those of a rotation: which component is left out


def write_compressed_ply(path: Path, arrays: Arrays) -> int:
    """Write atomically along a curve through space, without rows that hold NaN or Inf; return how many."""
    g, left_out = writable(arrays, curve=True)
    n = len(g["means"])
    logs = g["scales"].astype(np.float64).clip(-LOG_LIMIT, LOG_LIMIT)
    starts, chunk = np.arange(0, n, CHUNK), np.arange(n) // CHUNK
    chunks = np.zeros(len(starts), [(name, "<f4") for name in BOUNDS])
    words = np.zeros(n, [(name, "<u4") for name in WORDS])
    shares = []
    for k, values in enumerate((g["means"].astype(np.float64), logs, shown(g["sh0"]))):
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
        # No byte stands for 0: its two neighbours take turns, or colours would all shift to one side.
        turns = (rest == 0) & ((np.arange(n)[:, None] + np.arange(count)) % 2 == 0)
        levels = (np.floor((rest / 8 + 0.5) * 256) - turns).clip(0, 255).astype(np.uint8)
        names = [(f"f_rest_{k}", "u1") for k in range(count)]
        elements.append(PlyElement.describe(np.ascontiguousarray(levels).view(names)[:, 0], "sh"))
    comments = comments_of(World(), arrays.get("antialiased", False))  # its frame is said beside it
    with atomic_path(path) as tmp:
        PlyData(elements, byte_order="<", comments=comments).write(str(tmp))
    return left_out


def read_compressed_ply(path: Path) -> Arrays:
    """Read such a file. ValueError where it is damaged."""
    told, elements = told_by(header_of(path).comments), read_elements(path)
    if "vertex" not in elements or "chunk" not in elements:
        raise ValueError("a compressed PLY file has the elements chunk and vertex")
    vertices, chunks = elements["vertex"], elements["chunk"]
    n = len(vertices)
    words = _columns(vertices, WORDS, "u").astype(np.uint32)
    colored = "min_r" in (chunks.dtype.names or ())
    bounds = _columns(chunks, BOUNDS if colored else BOUNDS[:12], "f").astype(np.float64)
    if len(bounds) * CHUNK < n:
        raise ValueError(f"{len(bounds)} chunks of {CHUNK} are too few for {n:,} Gaussians")
    if not np.isfinite(bounds).all():
        raise ValueError("a bound of a chunk is not finite")
    if not colored:
        bounds = np.concatenate([bounds, np.tile([0.0] * 3 + [1.0] * 3, (len(bounds), 1))], axis=1)
    own = bounds[np.arange(n) // CHUNK].reshape(n, 3, 2, 3)

    def between(shares: NDArray[np.float64], k: int) -> NDArray[np.float64]:
        return own[:, k, 0] * (1 - shares) + own[:, k, 1] * shares

    color = _unpack(words[:, 3], (8, 8, 8, 8))
    three = (_unpack(words[:, 1], _TURN_BITS) - 0.5) * 2 * SPREAD
    return {
        "means": between(_unpack(words[:, 0], _BITS), 0),
        "scales": between(_unpack(words[:, 2], _BITS), 1),
        "quats": of_smallest_three(words[:, 1] >> np.uint32(sum(_TURN_BITS)), three),
        "opacities": to_logits(color[:, 3], 1 / 255),
        "sh0": of_colors(between(color[:, :3], 2)),
        "shN": _harmonics(elements.get("sh"), n),
        **told,
    }


def _harmonics(rows: NDArray[Any] | None, n: int) -> NDArray[np.float64]:
    if rows is None:
        return np.zeros((n, 0, 3))
    names = [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    if len(names) not in _COUNTS or len(rows) != n:
        raise ValueError(f"{len(rows):,} rows of {len(names)} harmonics, wanted {n:,} of one of {_COUNTS}")
    levels = _columns(rows, [f"f_rest_{k}" for k in range(len(names))], "u").astype(np.float64)
    values = ((levels + 0.5) / 256 - 0.5) * 8
    return values.reshape(n, 3, len(names) // 3).transpose(0, 2, 1)


def _columns(rows: NDArray[Any], names: Any, kind: str) -> NDArray[Any]:
    present = rows.dtype.names or ()
    missing = [name for name in names if name not in present or rows.dtype[name].kind != kind]
    if missing:
        raise ValueError(f"these properties are missing or of another type: {', '.join(missing)}")
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
