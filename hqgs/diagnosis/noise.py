"""Noise level of a photo from its flattest direction in patch space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hqgs.photos.pixels import Floats

LARGE_PATCH, SMALL_PATCH = 5, 3  # px
FEW_PATCHES = 4_000  # below this the large patch has too many directions for the photo
MIN_PATCHES = 200  # below this no estimate
LIMIT, SMALL_LIMIT = 2.5, 4.0  # levels: photos of fine texture without noise reach 1.9, small ones 3.2
MAX_PATCHES = 12_000
HALF_TILE = 24  # px: the photo is cut into a chessboard of tiles of this size


@dataclass(frozen=True)
class Noise:
    """White noise in a photo."""

    level: float  # levels of 1/255 in each channel: standard deviation
    limit: float  # levels: below this it could be fine texture


def estimate_noise(levels: Floats) -> Noise | None:
    """White noise in a photo [H, W, 3] of levels 0..255; None where too few pixels tell.

    Patches of all three channels span a space in which texture fills few directions and white noise all of
    them, so the smallest eigenvalue of their covariance is the noise variance (Pyatenko 2013, Liu et al.
    2013, Chen et al. 2015). The eigenvector comes from one half of the photo (the white fields of a
    chessboard) and its variance is measured on the other half, and the other way round: a minimum taken and
    measured on the same patches would come out too small. Patches with a value of exactly 0 or 255 are left
    out, where clipping takes noise away. Noise that a later step made smooth (JPEG, enlargement) is not seen.
    """
    height, width = levels.shape[:2]
    size = LARGE_PATCH if height * width >= 4 * FEW_PATCHES else SMALL_PATCH
    if min(height, width) < size:
        return None
    step = max(1, int(np.sqrt(height * width / MAX_PATCHES)))
    patches = np.lib.stride_tricks.sliding_window_view(levels, (size, size), axis=(0, 1))[::step, ::step]
    rows, columns = np.indices(patches.shape[:2]) * step // HALF_TILE
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
    return Noise(level, LIMIT if size == LARGE_PATCH else SMALL_LIMIT)
