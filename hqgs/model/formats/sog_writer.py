"""SOG version 2 as a file: what `hqgs.model.formats.sog` reads.

What a value that was written and read back may differ by: means half of 1/65535 of the range of
sign(x) log(1 + |x|) along each axis; opacities half of 1/255; rotations 0.02 rad. Scales and colours become
the nearest of 256 values each, harmonics the nearest of up to 65,536 sets: k-means has no bound, and `hqgs
export` measures what it changes.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.codebooks import codebook, palette
from hqgs.model.formats.rows import curve_order, finite_rows, pick, smallest_three, to_opacities
from hqgs.model.formats.sog import ACROSS, LARGEST, META

MOST_SETS = 1 << 16  # of harmonics: a label has two bytes
GAUSSIANS_A_SET = 4  # of harmonics
_BANDS = {0: 0, 3: 1, 8: 2, 15: 3}  # by coefficients
Array = NDArray[np.float64]


def write_sog(path: str | Path, arrays: Arrays) -> int:
    """Write a .sog file atomically, without rows that hold NaN or Inf; return how many those were.

    The Gaussians get an order along a curve through space, which packs well.
    """
    finite = finite_rows(arrays)
    g = pick(arrays, finite)
    if not finite.any():
        raise ValueError(f"{path}: no Gaussian to write, and a .sog file has one at least")
    files = encode_sog(pick(g, curve_order(g["means"])), bool(arrays.get("antialiased")))
    with atomic_path(Path(path)) as tmp, zipfile.ZipFile(tmp, "w", zipfile.ZIP_STORED) as out:
        for name, content in files.items():  # a fixed date: the same scene, the same bytes
            out.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    return int(len(finite) - finite.sum())


def encode_sog(g: Arrays, antialiased: bool) -> dict[str, bytes]:
    """The files of a scene by their names, of rows that are finite, in their order."""
    n = len(g["means"])
    means = g["means"].astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (logs.min(0), logs.max(0)) if n else (np.zeros(3), np.zeros(3))
    fixed = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.int64)
    scales, colors = codebook(g["scales"]), codebook(g["sh0"][:, 0])
    opacities = np.rint(255 * to_opacities(g["opacities"]))[:, None]
    files = {
        "means_l.webp": _webp(fixed % 256),
        "means_u.webp": _webp(fixed // 256),
        "scales.webp": _webp(scales[1]),
        "quats.webp": _webp(_smallest_three(g["quats"].astype(np.float64))),
        "sh0.webp": _webp(np.concatenate([colors[1], opacities], axis=1)),
    }
    meta: dict[str, Any] = {"version": 2, "count": n, "antialias": antialiased}
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    meta["scales"] = {"codebook": scales[0].tolist(), "files": ["scales.webp"]}
    meta["quats"] = {"files": ["quats.webp"]}
    meta["sh0"] = {"codebook": colors[0].tolist(), "files": ["sh0.webp"]}
    if (bands := _BANDS[g["shN"].shape[1]]) and n:
        wanted = min(MOST_SETS, -(-n // GAUSSIANS_A_SET))
        sets, labels = palette(g["shN"].reshape(n, -1), 1 + opacities[:, 0], wanted)
        book, codes = codebook(sets)
        table = np.zeros((-(-len(sets) // ACROSS) * ACROSS, codes.shape[1]), np.uint8)
        table[: len(sets)] = codes
        files["shN_centroids.webp"] = _webp(table.reshape(-1, 3), ACROSS * g["shN"].shape[1])
        files["shN_labels.webp"] = _webp(np.stack([labels % 256, labels // 256, 0 * labels], axis=1))
        meta["shN"] = {"count": len(sets), "bands": bands, "codebook": book.tolist()}
        meta["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    return {META: json.dumps(meta).encode()} | files


def _smallest_three(quats: Array) -> Array:
    """Three components in 8 bits each, and in the fourth byte which one, the largest, is not among them."""
    place, three = smallest_three(quats)
    three = np.rint((three / np.sqrt(2) + 0.5) * 255)
    return np.concatenate([three, LARGEST + place[:, None].astype(np.float64)], axis=1)


def _webp(values: NDArray[Any], across: int = 0) -> bytes:
    """Rows [N, 3 or 4] of bytes as the pixels of a picture, `across` in a row; 0: about square."""
    width = across or 4 * math.ceil(len(values) ** 0.5 / 4) or 4
    pixels = np.zeros((max(1, -(-len(values) // width)) * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    out = io.BytesIO()
    picture = Image.fromarray(pixels.reshape(-1, width, values.shape[1]))
    picture.save(out, "webp", lossless=True, exact=True, quality=50, method=4)
    return out.getvalue()
