"""SOG, the format of PlayCanvas: each value of the Gaussians a pixel of a lossless WebP picture.

A zip file, or the folder that it unpacks to: meta.json says which pictures there are, and what their bytes
stand for. Version 2 has codebooks, version 1, which names none, the ends of each range. `sog_writer.py`
writes version 2.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.rows import of_smallest_three, to_logits
from hqgs.photos.files import DECODE_ERRORS

META = "meta.json"
MOST_BYTES = 1 << 30  # of a picture in its file
MOST_GAUSSIANS = 50_000_000
ACROSS = 64  # centroids of harmonics in a row of their picture
_COEFFICIENTS = (0, 3, 8, 15)  # by bands
LARGEST = 252  # the alpha of a rotation whose w is its largest component, left out
Bytes = NDArray[np.uint8]


def read_sog(path: str | Path) -> Arrays:
    """Read a .sog file, or meta.json of one that was unpacked: float32 arrays.

    Raises FileNotFoundError, or ValueError that names the file.
    """
    path = Path(path)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as packed:
                inside = {Path(name).name: name for name in packed.namelist()}

                def member(name: str) -> bytes:
                    info = packed.getinfo(inside[name])
                    if info.file_size > MOST_BYTES:
                        raise ValueError(f"{name} promises {info.file_size:,} bytes")
                    return packed.read(info)

                return _read(member)
        if not path.name.lower().endswith(META):
            raise ValueError("it is no zip file")

        def beside(name: str) -> bytes:
            return path.read_bytes() if name == META else (path.parent / name).read_bytes()

        return _read(beside)
    except (
        *DECODE_ERRORS,
        zipfile.BadZipFile,
        LookupError,
        TypeError,
        ArithmeticError,
        RuntimeError,  # zipfile's, of a newer version or a password; of JSON too deep
    ) as error:
        if isinstance(error, FileNotFoundError) and not path.exists():
            raise
        raise ValueError(f"{path}: not a readable SOG scene: {error!r:.200}") from error


def _read(file: Callable[[str], bytes]) -> Arrays:
    meta = json.loads(file(META))
    count = int(meta["count"] if "count" in meta else meta["means"]["shape"][0])
    if not 0 < count <= MOST_GAUSSIANS:
        raise ValueError(f"{count} Gaussians")

    def pixels(part: dict[str, Any], number: int = 0, rows: int | None = count) -> Bytes:
        name = part["files"][number]
        if Path(name).name != name or name.startswith("."):
            raise ValueError(f"the picture {name!r} lies elsewhere")
        with Image.open(io.BytesIO(file(name))) as picture:
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
        sh0, opacities = together[:, :3], together[:, 3].astype(np.float32)
    found: Arrays = {
        "means": (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
        "scales": _coded(meta["scales"], pixels(meta["scales"])[:, :3]).astype(np.float32),
        "quats": _quats(pixels(meta["quats"])).astype(np.float32),
        "opacities": opacities,
        "sh0": sh0[:, None].astype(np.float32),
        "shN": _harmonics(meta.get("shN"), pixels, count).astype(np.float32),
    }
    for name in ("means", "scales", "quats", "opacities", "sh0", "shN"):
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{name} are not finite")
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
        raise ValueError("a rotation does not say which component it leaves out")
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
