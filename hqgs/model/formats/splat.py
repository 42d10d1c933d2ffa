""".splat files: 32 bytes a Gaussian, no header and no harmonics, which most web viewers read.

Position (3 float32), standard deviations (3 float32), red, green, blue and opacity (8 bits each), rotation
w x y z (8 bits each, 128 is 0). Those that show most come first: viewers draw while they load.

What a value that was written and read back may differ by: colours and opacities half of 1/255 (a colour out
of 0..1 becomes its end), rotations 0.02 rad, positions and scales float32 rounding. Harmonics are left out.

.ksplat files of GaussianSplats3D: sections of splats, positions in 16 bits around buckets, or in float32. A
header of 4096 bytes, one of 1024 for each section, then of each section the lengths of its buckets that are
not full, the buckets' middles, and its splats. Read alone: the format has no writer outside of its program.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import cast

import numpy as np

from hqgs.base.files import atomic_path
from hqgs.model.constants import LEAST_SCALE
from hqgs.model.formats.arrays import (
    TENSORS,
    Arrays,
    Format,
    of_colors,
    shown,
    to_logits,
    to_opacities,
    writable,
)

HEADER, SECTION = 4096, 1024
_KINDS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))  # positions, shapes, harmonics


def read_ksplat(path: Path) -> Arrays:
    """Read a .ksplat file of any compression. ValueError where it is damaged or not of this format."""
    data = path.read_bytes()
    if len(data) < HEADER:
        raise ValueError("not a readable .ksplat file: it ends within its header")
    most, sections = struct.unpack_from("<II", data, 4)
    level, low, high = *struct.unpack_from("<H", data, 20), *struct.unpack_from("<ff", data, 36)
    sections, at, parts = sections or most, HEADER + SECTION * most, list[dict[str, np.ndarray]]()
    if data[0] != 0 or level > 2 or not 0 < sections <= most or at > len(data):
        raise ValueError(f"not a readable .ksplat file: version {data[0]}, {sections} of {most} sections")
    for k in range(sections):
        used, room, size, buckets, block, width, scale, full, partial, degree = struct.unpack_from(
            "<IIIIfHxxI4xIIH", data, HEADER + SECTION * k
        )
        position, number, harmonic = _KINDS[level]
        row = [("means", position, 3), ("scales", number, 3), ("quats", number, 4), ("colors", "u1", 4)]
        kind = np.dtype([*row, ("sh", harmonic, (0, 9, 24, 45)[degree])])
        middles_at = at + 4 * partial
        splats_at = middles_at + buckets * width
        if splats_at + used * kind.itemsize > len(data) or (level and full > buckets):
            raise ValueError(f"not a readable .ksplat file: section {k} reaches beyond its end")
        g, means = np.frombuffer(data, kind, used, splats_at), 0.0
        if level:
            lengths = np.frombuffer(data, "<u4", partial, at).astype(np.int64)
            ends = np.concatenate([np.full(full, size, np.int64), lengths]).cumsum()
            middles = np.frombuffer(data, "<f4", 3 * buckets, middles_at).reshape(-1, 3)
            scale, whose = scale or 32767, np.searchsorted(ends, np.arange(used), "right")
            means = middles[whose] - 0.5 * block
        means = means + g["means"].astype(np.float64) * (0.5 * block / scale if level else 1)
        sh = g["sh"].astype(np.float64)
        if level == 2:
            sh = (low + sh / 255 * (high - low)) if low < high else sh / 255 * 3 - 1.5
        cuts = [3 * ((d + 1) ** 2 - 1) for d in range(1, degree)]  # band by band: red, green, blue
        bands = [b.reshape(used, 3, -1).transpose(0, 2, 1) for b in np.split(sh, cuts, 1)] if degree else []
        higher = np.concatenate([np.zeros((used, 0, 3)), *bands], axis=1)
        if used > room or (g["scales"] < 0).any():
            raise ValueError(f"not a readable .ksplat file: section {k} is damaged")
        parts.append(
            {name: g[name] for name in ("scales", "quats", "colors")} | {"means": means, "shN": higher}
        )
        at = splats_at + room * kind.itemsize
    most = max(part["shN"].shape[1] for part in parts)
    for part in parts:
        colors = part.pop("colors") / 255
        part["shN"] = np.pad(part["shN"], ((0, 0), (0, most - part["shN"].shape[1]), (0, 0)))
        part["scales"] = np.log(np.maximum(part["scales"].astype(np.float64), LEAST_SCALE))
        part |= {"opacities": to_logits(colors[:, 3], 1 / 255), "sh0": of_colors(colors[:, :3])}
    return cast(Arrays, {name: np.concatenate([part[name] for part in parts]) for name in TENSORS})


ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def write_splat(path: Path, arrays: Arrays) -> int:
    """Write atomically, without rows that hold NaN or Inf; return how many those were."""
    g, left_out = writable(arrays, ".splat")
    opacities, logs = to_opacities(g["opacities"]), g["scales"].astype(np.float64)
    quats = g["quats"].astype(np.float64)
    rows = np.empty(len(logs), ROW)
    rows["means"] = g["means"]
    rows["scales"] = np.exp(logs.clip(-87, 88))  # what float32 holds
    rows["colors"][:, :3] = np.rint(255 * shown(g["sh0"]).clip(0, 1))
    rows["colors"][:, 3] = np.rint(255 * opacities)
    rows["quats"] = np.rint(128 + 128 * quats / np.linalg.norm(quats, axis=1, keepdims=True)).clip(0, 255)
    first = np.argsort(-(logs.sum(axis=1) + np.log(opacities.clip(1e-300))), kind="stable")
    with atomic_path(path) as tmp:
        tmp.write_bytes(rows[first].tobytes())
    return left_out


def read_splat(path: Path) -> Arrays:
    """Read a .splat file, without harmonics.

    ValueError: no whole number of rows, a value that is not finite, or a scale below 0.
    """
    data = path.read_bytes()
    if len(data) % ROW.itemsize or not data:
        raise ValueError(f"not a .splat file: {len(data)} bytes cannot be split into rows of {ROW.itemsize}")
    rows = np.frombuffer(data, ROW)
    for name, least in (("means", -np.inf), ("scales", 0)):
        bad = np.flatnonzero(~(np.isfinite(rows[name]) & (rows[name] >= least)).all(axis=1))
        if bad.size:
            raise ValueError(f"{name} are not valid in {bad.size} rows, the first is {bad[0]}")
    return {
        "means": rows["means"].copy(),  # a view of a single row would be of `data`, which is constant
        "scales": np.log(np.maximum(rows["scales"], LEAST_SCALE)),
        "quats": (rows["quats"].astype(np.float64) - 128) / 128,
        "opacities": to_logits(rows["colors"][:, 3] / 255, 1 / 255),
        "sh0": of_colors(rows["colors"][:, :3] / 255),
        "shN": np.zeros((len(rows), 0, 3), np.float32),
    }


FORMATS = {"splat": Format(read_splat, write_splat, harmonics=False), "ksplat": Format(read_ksplat)}
