"""Photos of 16 bits a channel for what reads 8."""

from __future__ import annotations

import numpy as np
from PIL import Image


def grey(photo: Image.Image) -> Image.Image:
    """A photo in grey, 8 bits; of more bits those above count, which Pillow's own conversion cuts off."""
    if photo.mode.startswith("I"):
        levels = np.asarray(photo).astype(np.int64)
        return Image.fromarray(((levels + 128) // 257).clip(0, 255).astype(np.uint8))
    return (photo.convert("RGB") if photo.mode == "LAB" else photo).convert("L")
