"""Noise of a photo: its level, from the flattest direction in patch space, and how neighbours go together."""

from __future__ import annotations

import numpy as np

from hqgs.photos.jpeg import ENOUGH_BLOCKS, blocks_of
from hqgs.photos.pixels import Floats, luma

LARGE_PATCH, SMALL_PATCH = 5, 3  # px
LIMIT, SMALL_LIMIT = 2.5, 4.0  # levels: photos of fine texture without noise reach 1.9, small ones 3.2
MIN_PATCHES, MAX_PATCHES = 200, 12_000  # that are needed, and that are looked at


def estimate_noise(levels: Floats) -> tuple[float, float] | None:
    """White noise in a photo [H, W, 3] of levels 0..255: its standard deviation in each channel, and the
    least that no fine texture reaches, levels; None where too few pixels tell.

    Patches of all three channels span a space in which texture fills few directions and white noise all of
    them, so the smallest eigenvalue of their covariance is the noise variance (Pyatenko 2013, Liu et al.
    2013, Chen et al. 2015). The eigenvector comes from one half of the photo (the white fields of a
    chessboard) and its variance is measured on the other half, and the other way round: a minimum taken and
    measured on the same patches would come out too small. Patches with a value of exactly 0 or 255 are left
    out, where clipping takes noise away. Noise that a later step made smooth (JPEG, enlargement) is not seen.
    """
    height, width = levels.shape[:2]
    # below this the large patch has too many directions for the photo
    size = LARGE_PATCH if height * width >= 4 * 4_000 else SMALL_PATCH
    if min(height, width) < size:
        return None
    step = max(1, int(np.sqrt(height * width / MAX_PATCHES)))
    patches = np.lib.stride_tricks.sliding_window_view(levels, (size, size), axis=(0, 1))[::step, ::step]
    # px: the photo is cut into a chessboard of tiles of this size
    rows, columns = np.indices(patches.shape[:2]) * step // 24
    white = ((rows + columns) % 2 == 0).ravel()
    vectors = patches.reshape(-1, 3 * size * size)
    clipped = ((vectors == 0) | (vectors == 255)).any(axis=1)
    halves = [vectors[side & ~clipped] for side in (white, ~white)]
    if min(len(half) for half in halves) < MIN_PATCHES:
        return None
    covariances = [np.cov(half.T) for half in halves]
    variances = []
    for here, there in (covariances, covariances[::-1]):
        flattest = np.linalg.eigh(here)[1][:, 0]
        variances.append(flattest @ there @ flattest)
    level = float(np.sqrt(max(np.mean(variances), 0.0)))
    return level, LIMIT if size == LARGE_PATCH else SMALL_LIMIT


def neighbour_correlation(levels: Floats) -> float | None:
    """The least correlation of neighbouring pixels in the luma's noise, of a photo [H, W, 3], levels 0..255.

    None: too few blocks tell. Differences have 2 (1 - r) times the noise's power, where r is the correlation
    of their pixels: one minus the power over one pixel in that over two is r of neighbours, or less where two
    pixels still go together. What a photo shows raises it, so it is taken of the blocks with the least. White
    noise strong enough to be told comes to 0.12 at most, a phone's, denoised and as JPEG, to 0.24 to 0.5.
    """
    # px a side: blocks without clipped values tell how neighbours go together
    blocks = blocks_of(luma(levels), 16)
    blocks = blocks[((blocks > 0) & (blocks < 255)).all((1, 2))]
    one, two = (
        np.square(blocks[:, n:] - blocks[:, :-n]).mean((1, 2))
        + np.square(blocks[..., n:] - blocks[..., :-n]).mean((1, 2))
        for n in (1, 2)
    )
    if (two > 0).sum() < ENOUGH_BLOCKS:
        return None
    together = 1 - one[two > 0] / two[two > 0]
    return float(max(np.quantile(together, 0.05), 0.0))  # share of the blocks that show noise and little else
