"""Antialiased bicubic resizing, as MATLAB's imresize defines it.

Own code because no library at hand computes it: OpenCV, and torch and kornia without antialiasing, use
a = -0.75; torch's antialiased mode and Pillow (a = -0.5) cut the kernel off at the border, where imresize
mirrors the picture.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

CUBIC_A = -0.5  # of Keys's cubic: the value at which it reproduces quadratics
CUBIC_RADIUS = 2  # of the cubic, in samples
RESIZE_BAND = 8  # new rows at a time: what is between then fits into the caches
Pixels = NDArray[np.uint8] | NDArray[np.float32]


def resize_matrix(size_in: int, size_out: int) -> NDArray[np.float64]:
    """The matrix [size_out, size_in] that resizes one axis; each row sums to 1.

    Keys's cubic (1981, equation 4 with a = -0.5). Where the axis shrinks, the kernel is widened by
    size_in / size_out. Pixel centres are at half-integers, so that both borders of the picture stay where
    they are. Beyond a border the picture goes on mirrored with the edge pixel repeated (c b a | a b c).
    ValueError for a size below 1.
    """
    if size_in < 1 or size_out < 1:
        raise ValueError(f"sizes must be at least 1, got size_in {size_in}, size_out {size_out}")
    step = size_in / size_out
    widening = max(step, 1.0)
    centers = (np.arange(size_out) + 0.5) * step - 0.5
    first = np.floor(centers - CUBIC_RADIUS * widening).astype(np.int64)
    at = first[:, None] + np.arange(int(np.ceil(2 * CUBIC_RADIUS * widening)) + 2)
    weights = _cubic((at - centers[:, None]) / widening)
    weights /= weights.sum(axis=1, keepdims=True)

    at %= 2 * size_in  # the mirrored picture repeats after twice its size
    at = np.minimum(at, 2 * size_in - 1 - at)
    matrix = np.zeros((size_out, size_in))
    np.add.at(matrix, (np.arange(size_out)[:, None], at), weights)
    return matrix


def resize(image: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Resize `image` [H, W, C] to [height, width, C], computed in float64. The result may overshoot [0, 1].

    ValueError for an image of another shape or for a size below 1.
    """
    if image.ndim != 3:
        raise ValueError(f"image must be [H, W, C], got the shape {image.shape}")
    rows = csr_array(resize_matrix(image.shape[0], height))
    columns = csr_array(resize_matrix(image.shape[1], width))
    channels = image.shape[2]
    tall = rows @ image.astype(np.float64).reshape(image.shape[0], -1)  # [height, W C]
    turned = tall.reshape(height, -1, channels).swapaxes(0, 1).reshape(image.shape[1], -1)  # [W, height C]
    out = (columns @ turned).reshape(width, height, channels).swapaxes(0, 1)
    return np.ascontiguousarray(out, dtype=np.float32)


def _cubic(x: NDArray[np.float64]) -> NDArray[np.float64]:
    x = np.abs(x)
    inner = (CUBIC_A + 2) * x**3 - (CUBIC_A + 3) * x**2 + 1
    outer = CUBIC_A * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, inner, np.where(x < CUBIC_RADIUS, outer, 0.0))


def area_downscale(
    image: Pixels,
    mask: NDArray[np.bool_] | None,
    width: int,
    height: int,
    size: tuple[float, float] | None = None,
) -> tuple[Pixels, NDArray[np.bool_] | None]:
    """Mean over each new pixel's area in the old photo; parts of old pixels count by their share.

    With a mask, only what counts enters the mean (hidden colours must not bleed over the edge), and the new
    pixel counts where at least half of its area does. Not Pillow's BOX filter: that takes old pixels whole or
    not at all, which moves the picture by up to half a pixel at factors that are not whole.

    `size`: width and height of the picture in old pixels, where it ends within the last ones; None: it fills
    them.
    """
    size = size or (image.shape[1], image.shape[0])
    if image.shape[:2] == (height, width) and size == (width, height):
        return image, mask
    area = size[0] * size[1] / (height * width)
    if mask is None:
        return _as(image, _area_sum(image, height, width, size) / area), None
    share = _area_sum(mask, height, width, size)
    visible = _area_sum(np.where(mask[..., None], image, 0), height, width, size)
    hidden = _area_sum(np.where(mask[..., None], 0, image), height, width, size)
    seen = share > 1e-6 * area
    mean = np.where(seen[..., None], visible / np.where(seen, share, 1.0)[..., None], hidden / area)
    return _as(image, mean), share >= 0.5 * area


def _as(image: Pixels, values: NDArray[np.float64]) -> Pixels:
    """The values as the image's type; whole numbers are rounded."""
    if image.dtype == np.uint8:
        return np.rint(values).astype(np.uint8)
    return values.astype(np.float32)


def _area_sum(
    image: Pixels | NDArray[np.bool_], height: int, width: int, size: tuple[float, float]
) -> NDArray[np.float64]:
    """Sums over the new pixels' areas, [height, width, ...]. Whole numbers stay exact at whole factors."""
    old_height, old_width = image.shape[:2]
    columns = _overlaps(old_width, width, size[0])
    pixels = image.reshape(old_height, -1)
    out = np.empty((height, width, pixels.shape[1] // old_width))
    for made, needed, rows in _bands(old_height, height, size[1]):
        tall = rows @ pixels[needed].astype(np.float64)  # [B, W C]
        turned = tall.reshape(len(tall), old_width, -1).swapaxes(0, 1).reshape(old_width, -1)  # [W, B C]
        out[made] = (columns @ turned).reshape(width, len(tall), -1).swapaxes(0, 1)
    return out.reshape(height, width, *image.shape[2:])


@lru_cache(maxsize=8)  # cutting takes longer than using
def _bands(old: int, new: int, size: float) -> list[tuple[slice, slice, csr_array]]:
    """`_overlaps` of some new rows at a time: those, the old rows that they need, and what they share."""
    rows, bands = _overlaps(old, new, size), list[tuple[slice, slice, csr_array]]()
    for top in range(0, new, RESIZE_BAND):
        band = rows[top : top + RESIZE_BAND]
        first, last = int(band.indices.min()), int(band.indices.max()) + 1
        bands.append((slice(top, top + RESIZE_BAND), slice(first, last), band[:, first:last]))
    return bands


@lru_cache(maxsize=8)
def _overlaps(old: int, new: int, size: float) -> csr_array:
    """What each of `new` equal parts of 0..size shares with each of `old` pixels, in lengths of these."""
    edges = np.arange(new + 1) * size / new
    below, above = edges[:-1, None], edges[1:, None]
    first = np.minimum(below.astype(np.int64), old - 1)
    at = first + np.arange(int(np.ceil(size / new)) + 1)
    lengths = (np.minimum(above, at + 1) - np.maximum(below, at)).clip(0)
    part, place = np.nonzero((lengths > 0) & (at < old))
    starts = np.searchsorted(part, np.arange(new + 1))
    return csr_array((lengths[part, place], at[part, place], starts), shape=(new, old))
