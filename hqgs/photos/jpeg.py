"""JPEG files: encoding, decoding, quantisation tables."""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.pixels import Float32, as_floats, to_uint8

Tables = tuple[tuple[int, ...], tuple[int, ...]]  # steps of luma and of chroma, 64 each by rows; white is 255


def encode_jpeg(image: Float32, quality: int) -> bytes:
    """A colour JPEG file with 4:2:0 chroma of `image` [H, W, 3], which is clipped and rounded to 8 bits.

    By Pillow's libjpeg: the codec's quality scale is the one that benchmarks mean.
    """
    file = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(file, "JPEG", quality=quality, subsampling="4:2:0")
    return file.getvalue()


def decode_jpeg(data: bytes) -> Float32:
    """The pixels of a JPEG file, [H, W, 3], multiples of 1/255."""
    with Image.open(io.BytesIO(data)) as photo:
        return as_floats(np.asarray(photo.convert("RGB")))


@lru_cache
def tables_of_quality(quality: int) -> Tables:
    """The steps that libjpeg uses at this quality, 1..100: taken from a file that it writes."""
    file = io.BytesIO()
    Image.new("RGB", (16, 16)).save(file, "JPEG", quality=quality)
    with Image.open(file) as photo:
        tables: dict[int, list[int]] = photo.quantization  # pyright: ignore[reportAttributeAccessIssue]
    return tuple(tables[0]), tuple(tables[1])


@lru_cache(maxsize=1)
def standard_tables() -> NDArray[np.int64]:
    """libjpeg's luma tables for qualities 1..100, [100, 8, 8]."""
    return np.array([tables_of_quality(quality)[0] for quality in range(1, 101)]).reshape(-1, 8, 8)
