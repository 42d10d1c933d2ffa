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
from hqgs.model.constants import LEAST_SCALE, SH_C0
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.rows import finite_rows, pick, to_logits, to_opacities

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def write_splat(path: str | Path, arrays: Arrays) -> int:
    """Write atomically, without rows that hold NaN or Inf; return how many those were."""
    finite = finite_rows(arrays)
    g = pick(arrays, finite)
    if not finite.any():
        raise ValueError(f"{path}: no Gaussian to write, and a .splat file has one at least")
    opacities, logs = to_opacities(g["opacities"]), g["scales"].astype(np.float64)
    colors = 0.5 + SH_C0 * g["sh0"][:, 0].astype(np.float64)
    quats = g["quats"].astype(np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    rows = np.empty(len(logs), ROW)
    rows["means"] = g["means"]
    rows["scales"] = np.exp(logs.clip(-87, 88))  # what float32 holds
    rows["colors"][:, :3] = np.rint(255 * colors.clip(0, 1))
    rows["colors"][:, 3] = np.rint(255 * opacities)
    rows["quats"] = np.rint(128 + 128 * quats).clip(0, 255)
    first = np.argsort(-(logs.sum(axis=1) + np.log(opacities.clip(1e-300))), kind="stable")
    with atomic_path(path) as tmp:
        tmp.write_bytes(rows[first].tobytes())
    return int(len(finite) - finite.sum())


def read_splat(path: str | Path) -> Arrays:
    """Read a .splat file: float32 arrays without harmonics.

    Raises FileNotFoundError, or ValueError that names the file: no whole number of rows, a value that is not
    finite, or a scale below 0.
    """
    path = Path(path)
    data = path.read_bytes()
    if len(data) % ROW.itemsize or not data:
        raise ValueError(f"{path}: not a .splat file: {len(data)} bytes are no rows of {ROW.itemsize}")
    rows = np.frombuffer(data, ROW)
    for name in ("means", "scales"):
        bad = np.flatnonzero(
            ~np.isfinite(rows[name]).all(axis=1) | (name == "scales") * (rows[name] < 0).any(axis=1)
        )
        if bad.size:
            raise ValueError(
                f"{path}: {name} are no numbers of a Gaussian in {bad.size} rows, the first is {bad[0]}"
            )
    return {
        "means": rows["means"].astype(np.float32),
        "scales": np.log(np.maximum(rows["scales"], LEAST_SCALE)).astype(np.float32),
        "quats": ((rows["quats"].astype(np.float64) - 128) / 128).astype(np.float32),
        "opacities": to_logits(rows["colors"][:, 3] / 255, 1 / 255),
        "sh0": ((rows["colors"][:, None, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        "shN": np.zeros((len(rows), 0, 3), np.float32),
    }
