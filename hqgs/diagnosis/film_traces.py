"""Traces of a film's codec in a frame: the levels that its luma had."""

from __future__ import annotations

import numpy as np

from hqgs.diagnosis.constants import DECODED, FEWEST_LEVELS, FEWEST_PIXELS, LUMA_709, STEP
from hqgs.photos.jpeg import fine_detail
from hqgs.photos.pixels import LUMA, Floats


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
