""".ksplat files of GaussianSplats3D: sections of splats, positions in 16 bits around buckets, or in float32.

A header of 4096 bytes, one of 1024 for each section, then of each section the lengths of its buckets that are
not full, the buckets' middles, and its splats. Read alone: the format has no writer outside of its program.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.model.constants import LEAST_SCALE, SH_C0
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.rows import to_logits, whole_rows

HEADER, SECTION = 4096, 1024
_HARMONICS = (0, 9, 24, 45)  # values of a splat, by degree
_BANDS = (3, 5, 7)  # coefficients of a channel in each


def read_ksplat(path: str | Path) -> Arrays:
    """Read a .ksplat file of any compression: float32 arrays.

    Raises FileNotFoundError, or ValueError that names the file: damaged, cut off, or not of this format.
    """
    path = Path(path)
    data = path.read_bytes()
    try:
        return _read(data)
    except (struct.error, IndexError, ValueError) as error:
        raise ValueError(f"{path}: not a readable .ksplat file: {error}") from error


def _read(data: bytes) -> Arrays:
    if len(data) < HEADER:
        raise ValueError("it ends within its header")
    most, sections = struct.unpack_from("<II", data, 4)
    sections = sections or most  # which some writers leave out
    level, low, high = *struct.unpack_from("<H", data, 20), *struct.unpack_from("<ff", data, 36)
    if data[0] != 0 or level > 2 or not 0 < sections <= most or HEADER + SECTION * most > len(data):
        raise ValueError(f"version {data[0]}.{data[1]}, compression {level}, {sections} of {most} sections")
    if not low < high:
        low, high = -1.5, 1.5
    at, rows, shs = HEADER + SECTION * most, list[NDArray[np.void]](), list[NDArray[np.float64]]()
    for k in range(sections):
        head = HEADER + SECTION * k
        used, room, size, buckets = struct.unpack_from("<IIII", data, head)
        (block,) = struct.unpack_from("<f", data, head + 16)
        (width,) = struct.unpack_from("<H", data, head + 20)
        (scale_range,) = struct.unpack_from("<I", data, head + 24)
        full, partial, degree = struct.unpack_from("<IIH", data, head + 32)
        if degree >= len(_HARMONICS) or used > room:
            raise ValueError(f"section {k} has {used} of {room} splats and harmonics of degree {degree}")
        kind = _row(level, degree)
        lengths_at, middles_at = at, at + 4 * partial
        splats_at = middles_at + buckets * width
        at = splats_at + room * kind.itemsize
        if splats_at + used * kind.itemsize > len(data):
            raise ValueError(f"section {k} reaches beyond its end")
        found = np.frombuffer(data, kind, used, splats_at)
        means = found["means"].astype(np.float64)
        if level:
            if full + partial != buckets or width != 12:
                raise ValueError(f"section {k} has {buckets} buckets, and other numbers of them")
            lengths = np.frombuffer(data, "<u4", partial, lengths_at).astype(np.int64)
            ends = np.concatenate([np.full(full, size, np.int64), lengths]).cumsum()
            if used > (ends[-1] if buckets else 0):
                raise ValueError(f"section {k} has {used} splats, more than its buckets hold")
            middles = np.frombuffer(data, "<f4", 3 * buckets, middles_at).reshape(-1, 3)
            scale = scale_range or 32767
            means = (means - scale) * (0.5 * block / scale) + middles[
                np.searchsorted(ends, np.arange(used), "right")
            ]
        whole = np.empty(used, [("means", "f8", 3), *_SHARED])
        whole["means"] = means
        for name in ("scales", "quats", "colors"):
            whole[name] = found[name]
        rows.append(whole)
        values = found["sh"].astype(np.float64) if degree else np.zeros((used, 0))
        if level == 2:
            values = low + values / 255 * (high - low)
        shs.append(_harmonics(values))
    g = np.concatenate(rows)
    higher = max(sh.shape[1] for sh in shs)
    padded = [np.pad(sh, ((0, 0), (0, higher - sh.shape[1]), (0, 0))) for sh in shs]
    if (g["scales"] < 0).any():
        raise ValueError("scales are below 0")
    arrays: Arrays = {
        "means": g["means"].astype(np.float32),
        "scales": np.log(np.maximum(g["scales"], LEAST_SCALE)).astype(np.float32),
        "quats": g["quats"].astype(np.float32),
        "opacities": to_logits(g["colors"][:, 3] / 255, 1 / 255),
        "sh0": ((g["colors"][:, None, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        "shN": np.concatenate(padded).astype(np.float32),
    }
    if not whole_rows(arrays).all():
        raise ValueError("positions, scales, rotations or harmonics are not finite")
    return arrays


_SHARED: list[Any] = [("scales", "f8", 3), ("quats", "f8", 4), ("colors", "u1", 4)]


def _row(level: int, degree: int) -> np.dtype[Any]:
    """Of a splat: position, standard deviations, rotation w x y z, colour and opacity, harmonics."""
    position, number, harmonic = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    fields: list[Any] = [("means", position, 3), ("scales", number, 3), ("quats", number, 4)]
    fields.append(("colors", "u1", 4))
    if degree:
        fields.append(("sh", harmonic, _HARMONICS[degree]))
    return np.dtype(fields)


def _harmonics(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, K - 1, 3] of values that are stored band by band, of each band red, green, blue."""
    bands, at = [np.zeros((len(values), 0, 3))], 0
    for count in _BANDS:
        if at < values.shape[1]:
            band = values[:, at : at + 3 * count].reshape(-1, 3, count)
            bands.append(band.transpose(0, 2, 1))
            at += 3 * count
    return np.concatenate(bands, axis=1)
