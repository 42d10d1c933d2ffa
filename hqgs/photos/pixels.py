"""Pixels between 8 bits, floats and levels: the one place that converts them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    from torch import Tensor  # it takes seconds to load, and files are looked at without

Float32 = NDArray[np.float32]
Floats = NDArray[np.floating]
LUMA = np.array([0.299, 0.587, 0.114])  # of JPEG (ITU-R BT.601)
LUMA_NOISE = float(np.sqrt(np.square(LUMA).sum()))  # of the luma of white noise of 1 in each channel


def as_floats(photo: NDArray[np.uint8] | NDArray[np.float32]) -> NDArray[np.float32]:
    """A copy of a photo with white at 1."""
    return np.divide(photo, 255 if photo.dtype == np.uint8 else 1, dtype=np.float32)


def to_uint8(image: Float32) -> NDArray[np.uint8]:
    """The picture with 8 bits: clipped to [0, 1], 255 levels, rounded."""
    return np.rint(image.clip(0, 1) * 255).astype(np.uint8)


def floats(photo: Tensor) -> Tensor:
    """A photo with white at 1."""
    return photo if photo.is_floating_point() else photo / 255


def upright(image: NDArray[np.uint8], turn: int) -> NDArray[np.uint8]:
    """[H, W, 3] or [H, W] after so many quarter turns clockwise; see `View.quarter_turns`."""
    return np.ascontiguousarray(np.rot90(image, -turn))


def oriented(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """[H, W, ...] as EXIF's orientation, 1..8, shows it: mirrored in 2, 4, 5 and 7."""
    if orientation in (5, 7):
        pixels = pixels.swapaxes(0, 1)
    turns = {3: 2, 4: 2, 6: 3, 7: 2, 8: 1}.get(orientation, 0)  # counter-clockwise
    pixels = pixels[:, ::-1] if orientation in (2, 4) else pixels
    return np.ascontiguousarray(np.rot90(pixels, turns))


def to_levels(image: NDArray[np.uint8] | NDArray[np.float32], what: str) -> Floats:
    """A photo [H, W, 3], uint8 or float32 with white at 1, in levels of 1/255.

    ValueError, which begins with `what`, for another shape or type or for values that are not finite.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype not in (np.uint8, np.float32):
        raise ValueError(f"{what} must be [H, W, 3] uint8 or float32, got {image.shape} {image.dtype}")
    if not np.isfinite(image).all():
        raise ValueError(f"{what} holds NaN or Inf")
    levels = image.astype(np.float64)
    if image.dtype != np.uint8:
        levels *= 255
    return levels


def luma(levels: Floats) -> Floats:
    """[H, W] from [H, W, 3]."""
    return levels @ LUMA


def picture(image: Tensor | Floats | NDArray[np.uint8]) -> Image.Image:
    """A render or a photo [H, W, 3] as a picture of Pillow, which notebooks show.

    Floats have white at 1 and are clipped. ValueError for another shape.
    """
    pixels = image if isinstance(image, np.ndarray) else image.detach().numpy()
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"image has shape {list(pixels.shape)}, wanted [H, W, 3]")
    whole = pixels if pixels.dtype == np.uint8 else to_uint8(np.nan_to_num(pixels.astype(np.float32)))
    return Image.fromarray(np.ascontiguousarray(whole))


def png(image: Tensor | Floats | NDArray[np.uint8]) -> bytes:
    """The same as the bytes of a PNG file."""
    file = io.BytesIO()
    picture(image).save(file, "PNG")
    return file.getvalue()


def of_16(levels: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The nearest of 256 levels to each of 65,536."""
    return ((levels + 128) // 257).astype(np.uint8)


def grey(photo: Image.Image) -> Image.Image:
    """A photo in grey, 8 bits; of more bits those above count, which Pillow's own conversion cuts off."""
    if photo.mode.startswith("I"):
        return Image.fromarray(of_16(np.asarray(photo).astype(np.int64).clip(0, 65535)))
    return (photo.convert("RGB") if photo.mode == "LAB" else photo).convert("L")
