"""Traces of a film's codec in a frame: the levels that its luma had."""

from __future__ import annotations

import numpy as np

from hqgs.photos.blocks import fine_detail
from hqgs.photos.pixels import LUMA, Floats

LUMA_709 = np.array([0.2126, 0.7152, 0.0722])  # of films in HD (ITU-R BT.709); LUMA is that of the others
STEP = 255 / 219  # levels: of the luma of 8 bits from 16 (black) to 235 (white), which films store
DECODED = 0.35  # decoded frames have 0.48 and more, frames made smaller since 0.15 at most, photos 0.02
FEWEST_PIXELS, FEWEST_LEVELS = 10, 48  # of each level of the luma that counts, and of these


def film_detail(levels: Floats) -> float | None:
    """The `fine_detail` that a film's codec left in a frame [H, W, 3] of levels 0..255; None: no such frame.

    A frame that was decoded, and neither resized nor compressed since, has a luma of whole steps of `STEP`
    levels, but for the rounding of its colours, which blurs them by 0.19 levels.
    """
    if max(_comb(levels @ weights) for weights in (LUMA, LUMA_709)) < DECODED:
        return None
    return fine_detail(levels)


def _comb(grey: Floats) -> float:
    """How near a luma lies to whole steps of films: 1 if on them, 0 if it does not care.

    A mean over the levels that it has, so that a large plain area counts no more than its level.
    """
    level = np.rint(grey.clip(0, 255)).astype(np.int64).ravel()
    pixels = np.bincount(level, minlength=256)
    told = pixels >= FEWEST_PIXELS
    told[[0, -1]] = False  # what is clipped
    if told.sum() < FEWEST_LEVELS:
        return 0.0
    near = np.bincount(level, np.cos(2 * np.pi / STEP * grey).ravel(), len(pixels))
    return float((near[told] / pixels[told]).mean())
