"""Photo and mask files: their suffixes, sizes and pixels."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

HEIC_SUFFIXES = (".heic", ".heif")  # what iPhones write; an extra reads them
PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", *HEIC_SUFFIXES)
DECODE_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError),
    MemoryError,  # Pillow reads as many bytes as a chunk says it has
)


class UnreadableError(ValueError):
    """A photo or mask that cannot be decoded; the message names the file."""


def open_photo(path: Path) -> Image.Image:
    """Pillow's picture of the file, not decoded yet. One of DECODE_ERRORS where there is none."""
    if path.suffix.lower() in HEIC_SUFFIXES:
        try:
            import pillow_heif  # here: only such photos need it
        except ImportError as error:
            raise OSError("HEIC photos need the extra 'heic': pip install 'hqgs[heic]'") from error
        pillow_heif.register_heif_opener()
    return Image.open(path)


def check_whole(path: Path) -> tuple[int, int]:
    """Width and height of a photo that can be decoded to its end. UnreadableError: it cannot."""
    try:
        with open_photo(path) as photo:
            size = photo.size
            photo.draft("L", (size[0] // 8, size[1] // 8))  # a JPEG is quickly read like this
            photo.load()
            return size
    except UnidentifiedImageError as error:
        raise UnreadableError("no picture") from error
    except DECODE_ERRORS as error:
        raise UnreadableError(str(error) or type(error).__name__) from error


def stored_size(path: Path, what: str = "photo") -> tuple[int, int]:
    """Width and height that the photo's header promises, for a look before memory is taken for the pixels.

    Pillow refuses more than 179 million of them. Raises UnreadableError.
    """
    try:
        with open_photo(path) as photo:
            return photo.size
    except DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the {what} {path}: {e}") from e


def decode(
    path: Path, least: tuple[int, int] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The photo as uint8 RGB [H, W, 3], and its mask [H, W] (alpha >= 128) where it is not opaque everywhere.

    `least`: the width and height that are enough. A JPEG file is then decoded at 1/2, 1/4 or 1/8 of its
    sides, rounded up, where that is at least as much; `shrunk` tells by how much. None: at its full size.

    Greyscale becomes three equal channels, 16 bits become 8. Colours are as stored: nothing is composited,
    no colour profile is applied. EXIF orientation is not applied either: the cameras were computed for the
    pixels as stored, and a turned photo would no longer fit them. Raises UnreadableError.
    """
    try:
        with open_photo(path) as photo:
            if least is not None:
                photo.draft(None, least)  # pyright: ignore[reportArgumentType]  (None keeps the mode)
            if photo.mode == "F":
                raise ValueError("floating-point pixels have no agreed white")
            if photo.mode.startswith("I"):
                grey = np.asarray(photo).astype(np.int64)  # 16 bits; older Pillow calls the mode "I"
                if grey.min() < 0 or grey.max() > 65535:
                    raise ValueError(f"pixel values {grey.min()}..{grey.max()} are not 16 bit")
                return np.repeat(((grey + 128) // 257).astype(np.uint8)[..., None], 3, -1), None
            if photo.has_transparency_data:
                rgba = np.array(photo.convert("RGBA"))
                opaque = bool((rgba[..., 3] == 255).all())
                return np.ascontiguousarray(rgba[..., :3]), None if opaque else rgba[..., 3] >= 128
            return np.array(photo.convert("RGB")), None
    except DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the photo {path}: {e}") from e


def shrunk(stored: int, decoded: int) -> int:
    """By how much a side of a photo was divided, rounded up, when it was decoded: 1, 2, 4 or 8."""
    return next(factor for factor in (1, 2, 4, 8) if -(-stored // factor) <= decoded)


def decode_mask(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """The mask file as [height, width], True where it is not zero; the nearest pixel at another size."""
    w, h = stored_size(path, "mask")
    if abs(w * height - h * width) > width + height:
        raise ValueError(f"the mask {path} is {w} x {h}, its photo {width} x {height}: another shape")
    try:
        with open_photo(path) as file:
            pixels = np.asarray(file.convert("RGB") if file.mode == "P" else file)
    except DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the mask {path}: {e}") from e
    if pixels.ndim == 3:
        pixels = pixels[..., :3].max(-1)  # without alpha, which says nothing here
    rows = ((np.arange(height) + 0.5) * h / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * w / width).astype(np.int64)
    return pixels[rows][:, columns] != 0
