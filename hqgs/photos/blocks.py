"""The 8 x 8 blocks in which JPEG and films store pictures."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn

from hqgs.photos.constants import ENOUGH_BLOCKS, MAX_BLOCKS
from hqgs.photos.pixels import Floats, luma

T = TypeVar("T", bound=np.generic)
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
