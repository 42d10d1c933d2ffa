"""Antialiased bicubic resizing, as MATLAB's imresize defines it.

Own code because no library at hand computes it: OpenCV, and torch and kornia without antialiasing, use
a = -0.75; torch's antialiased mode and Pillow (a = -0.5) cut the kernel off at the border, where imresize
mirrors the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

A = -0.5  # of Keys's cubic: the value at which it reproduces quadratics
RADIUS = 2  # of the cubic, in samples


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
    first = np.floor(centers - RADIUS * widening).astype(np.int64)
    at = first[:, None] + np.arange(int(np.ceil(2 * RADIUS * widening)) + 2)
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
    inner = (A + 2) * x**3 - (A + 3) * x**2 + 1
    outer = A * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, inner, np.where(x < RADIUS, outer, 0.0))
