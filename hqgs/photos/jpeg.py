"""JPEG files, their quantisation tables, and the 8 x 8 blocks that they and films are made of."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.fft import dctn

from hqgs.photos.pixels import Float32, Floats, as_floats, luma, to_uint8

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


T = TypeVar("T", bound=np.generic)
# Of blocks, or coefficients that are not zero: with fewer no estimate is made; fewer without clipped pixels,
# and all blocks are taken.
ENOUGH_BLOCKS = 40
MAX_BLOCKS = 4_000  # whose details are looked at
_WAVES = np.add.outer(np.arange(8), np.arange(8))
_FINE, _COARSE = _WAVES >= 7, (_WAVES >= 3) & (_WAVES <= 5)


def blocks_of(image: NDArray[T], side: int = 8) -> NDArray[T]:
    """The whole blocks of `side` x `side` pixels of an image [H, W, ...], [n, side, side, ...]."""
    rows, columns = (length // side for length in image.shape[:2])
    cut = image[: rows * side, : columns * side].reshape(rows, side, columns, side, *image.shape[2:])
    return cut.swapaxes(1, 2).reshape(-1, side, side, *image.shape[2:])


def block_coefficients(grey: Floats, most: int, usable: NDArray[np.bool_] | None = None) -> Floats:
    """DCT coefficients [n, 8, 8] of up to `most` of the whole 8 x 8 blocks of a luma [H, W], in levels.

    Only blocks all of whose pixels are `usable`, where there are enough of them.
    """
    blocks = blocks_of(grey)
    chosen = np.arange(len(blocks))
    if usable is not None:
        whole = blocks_of(usable).all(axis=(1, 2))
        chosen = np.flatnonzero(whole) if whole.sum() >= ENOUGH_BLOCKS else chosen
    # A stride would fall in step with the rows of blocks; a fixed shuffle spreads the choice.
    chosen = np.random.default_rng(0).permutation(chosen)[:most]
    return np.asarray(dctn(blocks[chosen] - 128, axes=(1, 2), norm="ortho"))


def fine_detail(levels: Floats) -> float:
    """How much fine detail a picture [H, W, 3] of levels 0..255 has, at least 8 px a side.

    The ratio of the root mean squares of fine and coarser coefficients of its blocks. A film's codec leaves
    the less of it the coarser it is.
    """
    power = np.square(block_coefficients(luma(levels), MAX_BLOCKS)).mean(0)
    return float(np.sqrt(power[_FINE].mean() / max(power[_COARSE].mean(), 1e-9)))
