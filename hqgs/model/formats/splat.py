""".splat files: 32 bytes a Gaussian, no header and no harmonics, which most web viewers read.

Position (3 float32), standard deviations (3 float32), red, green, blue and opacity (8 bits each), rotation
w x y z (8 bits each, 128 is 0). Those that show most come first: viewers draw while they load.

What a value that was written and read back may differ by: colours and opacities half of 1/255 (a colour out
of 0..1 becomes its end), rotations 0.02 rad, positions and scales float32 rounding. Harmonics are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hqgs.base.files import atomic_path
from hqgs.model.constants import LEAST_SCALE
from hqgs.model.formats.arrays import Arrays, Format, of_colors, shown, to_logits, to_opacities, writable

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
        "means": rows["means"],
        "scales": np.log(np.maximum(rows["scales"], LEAST_SCALE)),
        "quats": (rows["quats"].astype(np.float64) - 128) / 128,
        "opacities": to_logits(rows["colors"][:, 3] / 255, 1 / 255),
        "sh0": of_colors(rows["colors"][:, :3] / 255),
        "shN": np.zeros((len(rows), 0, 3), np.float32),
    }


FORMATS = {"splat": Format(read_splat, write_splat, harmonics=False)}
