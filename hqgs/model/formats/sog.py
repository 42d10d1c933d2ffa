"""SOG, the format of PlayCanvas: each value of the Gaussians a pixel of a lossless WebP picture.

A zip file, or the folder that it unpacks to: meta.json says which pictures there are, and what their bytes
stand for. Version 2, which is written, has codebooks, version 1, which names none, the ends of each range.

What a value that was written and read back may differ by: means half of 1/65535 of the range of
sign(x) log(1 + |x|) along each axis; opacities half of 1/255; rotations 0.02 rad. Scales and colours become
the nearest of 256 values each, harmonics the nearest of up to 65,536 sets: k-means has no bound, and `hqgs
export` measures what it changes.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path
from hqgs.model.formats.arrays import (
    Arrays,
    Format,
    of_smallest_three,
    smallest_three,
    to_logits,
    to_opacities,
    writable,
)

CODES = 256  # values of a codebook
ROUNDS = 8  # of Lloyd's algorithm
Array = NDArray[np.float64]


def codebook(values: NDArray[np.floating]) -> tuple[Array, NDArray[np.uint8]]:
    """256 values, ascending, by Lloyd's algorithm, and for each of those given the nearest, in its shape."""
    flat = values.astype(np.float64).ravel()
    if not flat.size:
        return np.zeros(CODES), np.zeros(values.shape, np.uint8)
    # Where to begin: half of them where there are many values, half evenly over their range.
    ends = np.linspace(flat.min(), flat.max(), CODES // 2)
    book = np.sort(np.concatenate([np.quantile(flat, (np.arange(CODES // 2) + 0.5) / (CODES // 2)), ends]))
    for _ in range(ROUNDS):
        codes = np.searchsorted((book[1:] + book[:-1]) / 2, flat)
        counts = np.bincount(codes, minlength=CODES)
        sums = np.bincount(codes, flat, CODES)
        book = np.sort(np.where(counts > 0, sums / np.maximum(counts, 1), book))
    book = book.astype(np.float32).astype(np.float64)  # as readers hold them
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, flat).astype(np.uint8).reshape(values.shape)


def palette(rows: NDArray[np.floating], weights: Array, wanted: int) -> tuple[Array, NDArray[np.int64]]:
    """Up to `wanted` sets of values [P, D] that stand for the rows [N, D], and each row's number [N]; N > 0.

    k-means twice: of all rows, then in each cluster with its part of the sets, by how far its rows scatter:
    so a row is compared with few. `weights` [N], above 0, say how much a row counts in its set.
    """
    rows = rows.astype(np.float64)
    coarse = _kmeans(rows, round(wanted**0.5))
    members = [np.flatnonzero(coarse == k) for k in np.unique(coarse)]
    scatter = [np.square(rows[m] - rows[m].mean(0)).sum(1) @ weights[m] for m in members]
    shares = np.cumsum(scatter) / max(np.sum(scatter), np.finfo(np.float64).tiny)
    counts = 1 + np.diff(np.rint(shares * (wanted - len(members))).astype(int), prepend=0)
    labels, found = np.zeros(len(rows), np.int64), 0
    for m, count in zip(members, counts, strict=True):
        numbers, labels[m] = np.unique(_kmeans(rows[m], count), return_inverse=True)
        labels[m] += found
        found += len(numbers)
    totals = np.bincount(labels, weights, found)
    return np.stack([np.bincount(labels, weights * c, found) / totals for c in rows.T], axis=1), labels


def _kmeans(rows: Array, count: int) -> NDArray[np.int64]:
    """The number of each row's cluster, of at most `count`."""
    from scipy.cluster.vq import kmeans2  # here: to read a file needs no scipy

    centers = np.unique(rows[np.linspace(0, len(rows) - 1, max(1, count)).astype(int)], axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of clusters that became empty
        return kmeans2(rows, centers, iter=ROUNDS, minit="matrix", missing="warn")[1]


META = "meta.json"
ACROSS = 64  # centroids of harmonics in a row of their picture
LARGEST = 252  # the alpha of a rotation whose w is its largest component, left out
_COEFFICIENTS = (0, 3, 8, 15)  # by bands
Bytes = NDArray[np.uint8]


def write_sog(path: Path, arrays: Arrays) -> int:
    """Write a .sog file atomically, without rows that hold NaN or Inf; return how many those were.

    The Gaussians get an order along a curve through space, which packs well.
    """
    g, left_out = writable(arrays, ".sog", curve=True)
    files = encode_sog(g, bool(arrays.get("antialiased")))
    with atomic_path(path) as tmp, zipfile.ZipFile(tmp, "w", zipfile.ZIP_STORED) as out:
        for name, content in files.items():  # a fixed date: the same scene, the same bytes
            out.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    return left_out


def encode_sog(g: Arrays, antialiased: bool) -> dict[str, bytes]:
    """The files of a scene by their names, of rows that are finite, in their order."""
    n, coefficients = g["shN"].shape[:2]
    means = g["means"].astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (logs.min(0), logs.max(0)) if n else (np.zeros(3), np.zeros(3))
    fixed = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.int64)
    scales, colors = codebook(g["scales"]), codebook(g["sh0"][:, 0])
    opacities = np.rint(255 * to_opacities(g["opacities"]))[:, None]
    place, three = smallest_three(g["quats"].astype(np.float64))
    three = np.rint((three / np.sqrt(2) + 0.5) * 255)
    files = {
        "means_l.webp": _webp(fixed % 256),
        "means_u.webp": _webp(fixed // 256),
        "scales.webp": _webp(scales[1]),
        "quats.webp": _webp(np.concatenate([three, LARGEST + place[:, None]], axis=1)),
        "sh0.webp": _webp(np.concatenate([colors[1], opacities], axis=1)),
    }
    meta: dict[str, Any] = {"version": 2, "count": n, "antialias": antialiased}
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    meta["scales"] = {"codebook": scales[0].tolist(), "files": ["scales.webp"]}
    meta["quats"] = {"files": ["quats.webp"]}
    meta["sh0"] = {"codebook": colors[0].tolist(), "files": ["sh0.webp"]}
    if coefficients and n:
        wanted = min(1 << 16, -(-n // 4))  # a label has two bytes; four Gaussians share a set
        sets, labels = palette(g["shN"].reshape(n, -1), 1 + opacities[:, 0], wanted)
        book, codes = codebook(sets)
        table = np.zeros((-(-len(sets) // ACROSS) * ACROSS, codes.shape[1]), np.uint8)
        table[: len(sets)] = codes
        files["shN_centroids.webp"] = _webp(table.reshape(-1, 3), ACROSS * coefficients)
        files["shN_labels.webp"] = _webp(np.stack([labels % 256, labels // 256, 0 * labels], axis=1))
        meta["shN"] = dict[str, Any](count=len(sets), bands=_COEFFICIENTS.index(coefficients))
        meta["shN"]["codebook"] = book.tolist()
        meta["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    return {META: json.dumps(meta).encode()} | files


def _webp(values: NDArray[Any], across: int = 0) -> bytes:
    """Rows [N, 3 or 4] of bytes as the pixels of a picture, `across` in a row; 0: about square."""
    width = across or 4 * math.ceil(len(values) ** 0.5 / 4) or 4
    pixels = np.zeros((max(1, -(-len(values) // width)) * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    out = io.BytesIO()
    picture = Image.fromarray(pixels.reshape(-1, width, values.shape[1]))
    picture.save(out, "webp", lossless=True, exact=True, quality=50, method=4)
    return out.getvalue()


def read_sog(path: Path) -> Arrays:
    """Read a .sog file, or meta.json of one that was unpacked. ValueError, or one of Pillow or zipfile."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as packed:
            inside = {Path(name).name: name for name in packed.namelist()}

            def member(name: str) -> bytes:
                info = packed.getinfo(inside[name])
                if info.file_size > 1 << 30:  # bytes, of a picture
                    raise ValueError(f"{name} promises {info.file_size:,} bytes")
                return packed.read(info)

            return _read(member)
    if not path.name.lower().endswith(META):
        raise ValueError("not a readable SOG scene: it is not a zip file")

    def beside(name: str) -> bytes:
        return path.read_bytes() if name == META else (path.parent / name).read_bytes()

    return _read(beside)


def _read(file: Callable[[str], bytes]) -> Arrays:
    meta = json.loads(file(META))
    count = int(meta["count"] if "count" in meta else meta["means"]["shape"][0])

    def packed(part: dict[str, Any], number: int) -> bytes:
        name = part["files"][number]
        if Path(name).name != name or name.startswith("."):
            raise ValueError(f"the picture {name!r} is outside of its folder")
        return file(name)

    size = len(packed(meta["means"], 0))  # of positions' low bytes, which hardly pack
    if not 0 < count <= min(50_000_000, 100 * size):
        raise ValueError(f"{count} Gaussians, in {size} bytes of positions")

    def pixels(part: dict[str, Any], number: int = 0, rows: int | None = count) -> Bytes:
        name = part["files"][number]
        with Image.open(io.BytesIO(packed(part, number))) as picture:
            if rows is not None and picture.width * picture.height < rows:
                raise ValueError(f"{name} is {picture.width} x {picture.height}, too small for {rows}")
            found = np.asarray(picture.convert("RGBA"))
        return found if rows is None else found.reshape(-1, 4)[:rows]

    low, high = (pixels(meta["means"], k)[:, :3].astype(np.float64) for k in (0, 1))
    logs = _between(meta["means"], (low + 256 * high) / 65535)
    colors = pixels(meta["sh0"])
    if "codebook" in meta["sh0"]:
        sh0 = _coded(meta["sh0"], colors[:, :3])
        opacities = to_logits(colors[:, 3] / 255, 1 / 255)
    else:
        together = _between(meta["sh0"], colors / 255)
        sh0, opacities = together[:, :3], together[:, 3]
    found: Arrays = {
        "means": (np.sign(logs) * np.expm1(np.abs(logs))),
        "scales": _coded(meta["scales"], pixels(meta["scales"])[:, :3]),
        "quats": _quats(pixels(meta["quats"])),
        "opacities": opacities,
        "sh0": sh0[:, None],
        "shN": _harmonics(meta.get("shN"), pixels, count),
    }
    if meta.get("antialias") is True:
        found["antialiased"] = True
    return found


def _between(part: dict[str, Any], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = (np.array(part[end], np.float64) for end in ("mins", "maxs"))
    return low + shares * (high - low)


def _coded(part: dict[str, Any], values: Bytes) -> NDArray[np.float64]:
    """What bytes stand for: an entry of the codebook, or a place between the ends of the range."""
    if "codebook" in part:
        book = np.array(part["codebook"], np.float64)
        if np.isnan(book[0]):  # as some writers leave it: of the rest, evenly
            book[0] = book[1] + (book[1] - book[-1]) / (len(book) - 1)
        return book[values]
    return _between(part, values / 255)


def _quats(packed: Bytes) -> NDArray[np.float64]:
    """w x y z of three components in 8 bits each, and the place of the fourth, the largest."""
    place = packed[:, 3].astype(np.int64) - LARGEST
    if (place < 0).any():
        raise ValueError("a rotation lacks the number of its omitted component")
    return of_smallest_three(place, (packed[:, :3] / 255 - 0.5) * np.sqrt(2))


def _harmonics(part: dict[str, Any] | None, pixels: Callable[..., Bytes], count: int) -> NDArray[np.float64]:
    """[N, K - 1, 3]: each Gaussian has the number of one of the centroids."""
    if not part:
        return np.zeros((count, 0, 3))
    centroids, labels = pixels(part, 0, None), pixels(part, 1)
    wide = centroids.shape[1] // ACROSS
    coefficients = _COEFFICIENTS[part["bands"]] if "bands" in part else wide
    if coefficients not in _COEFFICIENTS or coefficients * ACROSS > centroids.shape[1]:
        raise ValueError(f"harmonics of {coefficients} coefficients in {centroids.shape[1]} columns")
    number = labels[:, 0].astype(np.int64) + 256 * labels[:, 1].astype(np.int64)
    table = centroids[:, : coefficients * ACROSS, :3].reshape(-1, coefficients, 3)
    return _coded(part, table)[number]


FORMATS = {"sog": Format(read_sog, write_sog, antialiased=True), META: Format(read_sog, of="sog")}
