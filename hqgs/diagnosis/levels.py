"""What every estimator looks at: photos as levels 0..255, and their luma."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

LUMA = np.array([0.299, 0.587, 0.114])  # of JPEG (ITU-R BT.601)
LUMA_NOISE = float(np.sqrt(np.square(LUMA).sum()))  # of the luma of white noise of 1 in each channel


def to_levels(image: NDArray[np.uint8] | NDArray[np.float32], what: str) -> Floats:
    """A photo [H, W, 3], uint8 or float32 with white at 1, in levels of 1/255.

    ValueError, which begins with `what`, for another shape or type or for values that are not finite.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype not in (np.uint8, np.float32):
        raise ValueError(f"{what} must be [H, W, 3] uint8 or float32, got {image.shape} {image.dtype}")
    if not np.isfinite(image).all():
        raise ValueError(f"{what} holds NaN or Inf")
    return image.astype(np.float64) * (1 if image.dtype == np.uint8 else 255)


def luma(levels: Floats) -> Floats:
    """[H, W] from [H, W, 3]."""
    return levels @ LUMA
