"""The kernels of defocus and motion blur."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def disc_kernel(radius: float) -> NDArray[np.float64]:
    """A filled disc of `radius` px (defocus), square and of odd size, sum 1. kornia has none.

    The rim is antialiased: each pixel counts with the share of its area that lies in the disc, to 1e-3.
    """
    reach = math.ceil(radius + 0.5) - 1
    columns = np.arange(-reach, reach + 1)
    heights = columns[:, None] + (np.arange(64) + 0.5) / 64 - 0.5  # 64 lines through each row of pixels
    half_chords = np.sqrt(np.maximum(radius**2 - heights**2, 0))[..., None]
    left, right = (np.clip(end, columns - 0.5, columns + 0.5) for end in (-half_chords, half_chords))
    kernel = (right - left).mean(axis=1)
    kernel += kernel.T
    return kernel / kernel.sum()


def motion_kernel(length: float, angle: float) -> NDArray[np.float64]:
    """A straight line of `length` px through the centre, square and of odd size, sum 1.

    Convolving with it is the mean of the photo over shifts, by bilinear interpolation, along `length` px in
    the direction `angle` (radians from x towards y, which points down). The integral is exact. Not kornia's
    motion kernel: that one takes odd whole lengths only, and turns a row of pixels, which thins the line.
    """
    along = np.array([math.cos(angle), math.sin(angle)]) * length / 2
    reach = math.ceil(np.abs(along).max()) + 1
    # Between the places where the line crosses a row or column of pixel centres, the bilinear weights are
    # quadratic in the position, for which two Gauss points per stretch are exact.
    ends = [np.array([-1.0, 1.0])]
    ends += [np.arange(-reach, reach + 1) / half for half in along if abs(half) > 1e-9]
    breaks = np.unique(np.concatenate(ends).clip(-1, 1))
    middles, halves = (breaks[1:] + breaks[:-1]) / 2, np.diff(breaks) / 2
    at = np.concatenate([middles - halves / math.sqrt(3), middles + halves / math.sqrt(3)])
    weights = np.concatenate([halves, halves]) / 2

    x, y = at * along[0], at * along[1]
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for row in (0, 1):
        for column in (0, 1):
            share = (1 - np.abs(x - left - column)) * (1 - np.abs(y - top - row))
            np.add.at(kernel, (top + row + reach, left + column + reach), weights * share)
    return kernel / kernel.sum()
