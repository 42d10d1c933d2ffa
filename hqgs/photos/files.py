"""Photo and mask files: their suffixes, sizes and pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from hqgs.photos.film_colors import toned
from hqgs.photos.pixels import grey, of_16, oriented
from hqgs.photos.profiles import Colors, colors_of, in_srgb, in_srgb_of_16

LARGEST = 1 << 28  # px of a photo: more come from damaged files, and would fill the memory
DECODE_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError),
    MemoryError,  # Pillow reads as many bytes as a chunk says it has
    RuntimeError,  # of the decoders of AVIF and HEIC
)


_HEAD = 64  # bytes that tell HEIC from other files
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1")
_registering = Lock()
_LOSSY = ("JPEG", "MPO", "HEIF", "JPEG2000", "AVIF")  # formats that change values around an edge
GRID = 32  # cells of a glance's small picture, each way
_FLOATS = "pixels are floating-point, of which the white level is unknown: save it with 8 or 16 bits"
_NOT_RGB = ("P", "CMYK", "LAB", "YCbCr", "HSV")  # modes whose channels are no brightness
_HALF = 128  # of 8 bits: from here on a pixel of a lossy mask counts


class UnreadableError(ValueError):
    """A photo or mask that cannot be decoded; the message names the file."""


class MisfitError(UnreadableError):
    """A photo that is no picture of its camera; the message names it."""


def open_photo(path: Path) -> Image.Image:
    """Pillow's picture of the file, not decoded yet: by what it holds, whatever its suffix says.

    One of DECODE_ERRORS where there is none.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if is_heic(head) and not _register_heic():
        raise OSError("HEIC photos need the extra 'heic': pip install 'hqgs[heic]'")
    if Image.MAX_IMAGE_PIXELS is not None and Image.MAX_IMAGE_PIXELS < LARGEST:
        Image.MAX_IMAGE_PIXELS = LARGEST  # for the process: phones take 108 and 200 megapixels
    photo = Image.open(path)
    if photo.width * photo.height > LARGEST:
        raise OSError(f"{photo.width} x {photo.height} px are more than {LARGEST / 1e6:.0f} megapixels")
    return photo


def is_heic(head: bytes) -> bool:
    """Whether a file that begins so holds an HEIC or HEIF picture: by the brands of its first box."""
    avif = b"avif" in head[8:]  # which Pillow reads itself
    return head[4:8] == b"ftyp" and not avif and any(brand in head[8:] for brand in _HEIC_BRANDS)


def needs_heic(path: Path) -> bool:
    """Whether a photo needs the extra that reads HEIC, and it is not there."""
    try:
        with path.open("rb") as file:
            return is_heic(file.read(_HEAD)) and not _register_heic()
    except OSError:
        return False


def _register_heic() -> bool:
    """Teach Pillow HEIC, once for the process; whether that worked."""
    try:
        import pillow_heif  # here: only such photos need it
    except ImportError:
        return False
    with _registering:
        if "HEIF" not in Image.OPEN:
            pillow_heif.register_heif_opener()
    return True


@dataclass(frozen=True)
class Glance:
    """What a quick look at a whole photo tells."""

    size: tuple[int, int]  # width and height as stored
    format: str  # Pillow's name of what the file holds
    small: NDArray[np.uint8]  # [GRID, GRID], its brightness: nearly the same for the same picture
    colors: Colors | None = None  # as `colors_of` has them


def glance(path: Path) -> Glance:
    """Look at a photo that can be decoded to its end. UnreadableError: it cannot."""
    try:
        if not path.stat().st_size:
            raise UnreadableError("0 bytes: its download or copy was not finished")
        with open_photo(path) as photo:
            if photo.mode == "F":
                raise UnreadableError(_FLOATS)
            size, colors = photo.size, colors_of(photo, path)
            photo.draft("L", (max(1, size[0] // 8), max(1, size[1] // 8)))  # a JPEG is quickly read like this
            small = grey(photo).resize((GRID, GRID), Image.Resampling.BOX)
            return Glance(size, photo.format or "", np.array(small), colors)
    except UnidentifiedImageError as error:
        raise UnreadableError("no picture") from error
    except UnreadableError:
        raise
    except DECODE_ERRORS as error:
        raise UnreadableError(str(error) or type(error).__name__) from error


def stored_size(path: Path, what: str = "photo") -> tuple[int, int]:
    """Width and height that the photo's header promises, for a look before memory is taken for the pixels.

    Raises UnreadableError, also for more than LARGEST.
    """
    try:
        with open_photo(path) as photo:
            return photo.size
    except DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the {what} {path}: {e}") from e


def is_cut_out(path: Path) -> bool | None:
    """Whether a photo can be transparent: of an object that was cut out, or rendered before nothing.

    None: it cannot be opened.
    """
    try:
        with open_photo(path) as photo:
            return photo.has_transparency_data
    except DECODE_ERRORS:
        return None


def told_colors(path: Path) -> Colors | None:
    """What a photo says of its colours, as `colors_of` has it; None also where it cannot be opened."""
    try:
        with open_photo(path) as photo:
            return colors_of(photo, path)
    except DECODE_ERRORS:
        return None


def decode(
    path: Path, least: tuple[int, int] | None = None, over: tuple[float, float, float] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The photo as uint8 RGB [H, W, 3], and its mask [H, W] (alpha >= 128) where it is not opaque everywhere.

    `least`: the width and height that are enough. A JPEG file is then decoded at 1/2, 1/4 or 1/8 of its
    sides, rounded up, where that is at least as much; `shrunk` tells by how much. None: at its full size.

    `over`: a colour (R, G, B, 1 is white) that shows where the photo is transparent, in place of a mask; a
    fourth channel then has how empty each pixel is, 255 less its alpha.

    Greyscale becomes three equal channels, 16 bits become 8, colours of another space than sRGB become sRGB
    (`colors_of`). EXIF orientation is not applied: the cameras were computed for the pixels as stored, and a
    turned photo would no longer fit them. Raises UnreadableError.
    """
    try:
        with open_photo(path) as photo:
            colors = colors_of(photo, path)
            if least is not None:
                photo.draft(None, least)  # pyright: ignore[reportArgumentType]  (None keeps the mode)
            if photo.mode == "F":
                raise ValueError(_FLOATS)
            if photo.mode.startswith("I"):
                levels = np.asarray(photo).astype(np.int64)  # 16 bits; older Pillow calls the mode "I"
                if levels.min() < 0 or levels.max() > 65535:
                    raise ValueError(f"pixel values {levels.min()}..{levels.max()} are not 16 bit")
                if colors is not None and colors.profile:
                    rgb = in_srgb_of_16(levels, colors)
                else:
                    rgb = np.repeat(of_16(levels)[..., None], 3, -1)
                clear = levels == photo.info.get("transparency", -1)  # of PNG: one grey, which is none
                rgba = np.dstack([rgb, np.where(clear, 0, 255).astype(np.uint8)])
            elif photo.has_transparency_data:
                rgba = np.array(photo.convert("RGBA"))
                if colors is not None and colors.known:
                    rgba[..., :3] = _as_srgb(path, photo, colors)
            else:
                rgb = np.array(photo.convert("RGB")) if colors is None else _as_srgb(path, photo, colors)
                return (rgb if over is None else np.dstack([rgb, np.zeros_like(rgb[..., 0])])), None
            if over is not None:
                alpha = rgba[..., 3:] / 255
                mixed = alpha * rgba[..., :3] + (1 - alpha) * 255 * np.array(over)
                return np.rint(np.dstack([mixed, 255 - rgba[..., 3]])).astype(np.uint8), None
            opaque = bool((rgba[..., 3] == 255).all())
            return np.ascontiguousarray(rgba[..., :3]), None if opaque else rgba[..., 3] >= 128
    except DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the photo {path}: {e}") from e


def _as_srgb(path: Path, photo: Image.Image, colors: Colors) -> NDArray[np.uint8]:
    """A photo of other colours as sRGB, [H, W, 3]; of 16 bits a channel all count, which Pillow cuts off."""
    with open_photo(path) as again:
        file: Any = again
        raw = _rawmode(file)
        if colors.profile and raw is not None:
            other = raw[:-1] + ("L" if raw[-1] == "B" else "B")
            file.tile = [
                tile._replace(args=other if isinstance(tile.args, str) else (other, *tile.args[1:]))
                for tile in file.tile
            ]
            below = np.asarray(again)[..., :3].astype(np.int64)
            return in_srgb_of_16(np.asarray(photo)[..., :3].astype(np.int64) * 256 + below, colors)
    found = np.array(in_srgb(photo, colors))
    if colors.hdr == (0, 0):
        return found
    return np.rint(255 * toned(found / 255, colors.hdr[1], colors.hdr[0])).astype(np.uint8)


def _rawmode(photo: Any) -> str | None:
    """Of an opened photo whose three or four channels have 16 bits each; None: of another one."""
    args = photo.tile[0].args if photo.tile else None
    raw = args if isinstance(args, str) else args[0] if isinstance(args, tuple) and args else None
    return raw if isinstance(raw, str) and raw[:-1] in ("RGB;16", "RGBA;16") else None


def shrunk(stored: int, decoded: int) -> int:
    """By how much a side of a photo was divided, rounded up, when it was decoded: 1, 2, 4 or 8."""
    return next(factor for factor in (1, 2, 4, 8) if -(-stored // factor) <= decoded)


def is_shown(path: Path, width: int, height: int, orientation: int = 1) -> bool | None:
    """Whether a mask is of the photo as EXIF's orientation shows it, not as its `width` x `height` px lie in
    the file: by its shape. None: that does not tell. ValueError where it has the shape of neither."""
    w, h = stored_size(path, "mask")
    stored = abs(w * height - h * width) <= width + height
    shown = abs(w * width - h * height) <= width + height if orientation >= 5 else stored
    if not (stored or shown):
        raise ValueError(f"the mask {path} is {w} x {h}, its photo {width} x {height}: another aspect ratio")
    return None if stored and shown and orientation > 1 else not stored


def decode_mask(
    path: Path, width: int, height: int, orientation: int = 1, shown: bool = False
) -> NDArray[np.bool_]:
    """The mask file as [height, width], True where it counts; the nearest pixel at another size.

    What is not zero counts; in a lossy file, which blurs its edges, what is at least half of white. A file
    whose colours are all one, but whose alpha is not, has its mask in alpha, from half on. A mask of the
    photo as EXIF's orientation shows it (`shown`, where shapes do not tell) is turned to lie as the photo.
    """
    told = is_shown(path, width, height, orientation)
    shown = shown if told is None else told
    if shown and orientation >= 5:
        width, height = height, width
    try:
        with open_photo(path) as file:
            lossy = file.format in _LOSSY
            if file.format == "WEBP":  # lossy where it has no picture that is stored exactly
                with path.open("rb") as raw:
                    lossy = b"VP8L" not in raw.read(1 << 16)
            pixels = np.asarray(file.convert("RGB") if file.mode in _NOT_RGB else file)
    except DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the mask {path}: {e}") from e
    alpha = pixels[..., -1] if pixels.ndim == 3 and pixels.shape[2] in (2, 4) else None
    if pixels.ndim == 3:
        pixels = pixels[..., : 3 if pixels.shape[2] >= 3 else 1].max(-1)
    if alpha is not None and pixels.min() == pixels.max() and alpha.min() < alpha.max():
        pixels, lossy = alpha, True
    counts = pixels >= _HALF if lossy else pixels != 0
    h, w = counts.shape
    rows = ((np.arange(height) + 0.5) * h / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * w / width).astype(np.int64)
    return oriented(counts[rows][:, columns], {6: 8, 8: 6}.get(orientation, orientation) if shown else 1)
