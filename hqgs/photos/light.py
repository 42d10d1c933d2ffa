"""Linear light and its sRGB encoding (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

OFFSET, EXPONENT = 0.055, 2.4  # of sRGB's curve above its straight toe
Real = TypeVar("Real", bound="np.floating[Any]")


def to_linear(srgb: NDArray[Real]) -> NDArray[Real]:
    """sRGB values to linear light; white is 1 in both.

    Beyond [0, 1] the curve goes on as it is (straight below 0), so that noise loses nothing on the way.
    """
    curve = ((np.maximum(srgb, 0.04045) + OFFSET) / (1 + OFFSET)) ** EXPONENT
    return np.where(srgb <= 0.04045, srgb / 12.92, curve).astype(srgb.dtype)


def to_srgb(linear: NDArray[Real]) -> NDArray[Real]:
    """Linear light to sRGB values, the inverse of `to_linear`."""
    curve = (1 + OFFSET) * np.maximum(linear, 0.0031308) ** (1 / EXPONENT) - OFFSET
    return np.where(linear <= 0.0031308, 12.92 * linear, curve).astype(linear.dtype)
