"""Photos of 16 bits a channel for what reads 8."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def of_16(levels: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The nearest of 256 levels to each of 65,536."""
    return ((levels + 128) // 257).astype(np.uint8)


def grey(photo: Image.Image) -> Image.Image:
    """A photo in grey, 8 bits; of more bits those above count, which Pillow's own conversion cuts off."""
    if photo.mode.startswith("I"):
        return Image.fromarray(of_16(np.asarray(photo).astype(np.int64).clip(0, 65535)))
    return (photo.convert("RGB") if photo.mode == "LAB" else photo).convert("L")
