"""The quantisation cells of a JPEG photo, as a loss: what the file leaves open costs nothing.

A JPEG file tells of each DCT coefficient only the nearest multiple of its step. A render whose coefficient
lies within half a step of it would give the same file, so a pixel loss, which pulls it to the decoded
photo, paints the codec's blocks. The views fill the cells: each photo is quantised in another place.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hqgs.separable import Separable

BLOCK = 8
# R, G, B to Y, Cb, Cr (ITU-T T.871, without the offset of the chroma, which no difference sees).
TO_YCBCR = (
    (0.299, 0.587, 0.114),
    (-0.168735892, -0.331264108, 0.5),
    (0.5, -0.418687589, -0.081312411),
)

Tables = tuple[tuple[int, ...], tuple[int, ...]]  # steps of luma and of chroma, 64 each by rows; white is 255


@lru_cache
def tables_of_quality(quality: int) -> Tables:
    """The steps that libjpeg uses at this quality, 1..95: taken from a file that it writes."""
    file = io.BytesIO()
    Image.new("RGB", (16, 16)).save(file, "JPEG", quality=quality)
    with Image.open(file) as photo:
        tables: dict[int, list[int]] = photo.quantization  # pyright: ignore[reportAttributeAccessIssue]
    return tuple(tables[0]), tuple(tables[1])


@dataclass(frozen=True)
class Coefficients:
    """DCT coefficients on the scale where white is 1."""

    luma: Tensor  # [rows, columns, 1], padded to whole blocks
    chroma: Tensor  # [rows, columns, 2] of the channels at half the size


class JpegCells:
    """Distance of a picture to the cells of a JPEG photo with 4:2:0 chroma."""

    def __init__(self, tables: Tables, height: int, width: int) -> None:
        """`height`, `width`: of the photo, px."""
        self._luma = Separable.of(*(_analysis(side, halve=False) for side in (height, width)))
        self._chroma = Separable.of(*(_analysis(side, halve=True) for side in (height, width)))
        luma, chroma = (torch.tensor(table).reshape(BLOCK, BLOCK) / 255 for table in tables)
        self._luma_steps = _tile(luma, self._luma)
        self._chroma_steps = _tile(chroma, self._chroma)
        self._pixels = height * width
        self._to_ycbcr = torch.tensor(TO_YCBCR).T

    def coefficients(self, image: Tensor) -> Coefficients:
        """Of a picture [H, W, 3], white at 1; differentiable."""
        channels = image @ self._to_ycbcr.to(image)
        return Coefficients(self._luma(channels[..., :1]), self._chroma(channels[..., 1:]))

    def centres(self, photo: Tensor) -> Coefficients:
        """The centres of the cells of a decoded photo [H, W, 3]: the nearest multiples of the steps.

        Decoding clips, rounds and smooths the chroma, so the coefficients of the decoded pixels are a little
        off the multiples that the file holds.
        """
        c = self.coefficients(photo)
        return Coefficients(_nearest(c.luma, self._luma_steps), _nearest(c.chroma, self._chroma_steps))

    def loss(self, image: Tensor, centres: Coefficients) -> Tensor:
        """Mean distance to the cells per colour value, a scalar; 0 where the file could be this picture's.

        Args:
            image: [H, W, 3], white at 1.
            centres: of the photo.
        """
        c = self.coefficients(image)
        outside = _outside(c.luma, centres.luma, self._luma_steps)
        return (outside + _outside(c.chroma, centres.chroma, self._chroma_steps)) / (3 * self._pixels)


def _outside(c: Tensor, centre: Tensor, steps: Tensor) -> Tensor:
    return torch.relu((c - centre).abs() - steps / 2).sum()


def _nearest(c: Tensor, steps: Tensor) -> Tensor:
    return torch.round(c / steps) * steps


def _tile(steps: Tensor, operator: Separable) -> Tensor:
    rows, columns = (side // BLOCK for side in operator.size)
    return steps.repeat(rows, columns)[..., None]


def _analysis(side: int, halve: bool) -> NDArray[np.float64]:
    """The matrix from pixels to DCT coefficients along one axis, [whole blocks, side].

    The last pixel is repeated to fill the last block, as libjpeg does; `halve` takes means of two first.
    """
    unit = 2 * BLOCK if halve else BLOCK
    padded = -(-side // unit) * unit
    matrix: NDArray[np.float64] = np.eye(side)[np.minimum(np.arange(padded), side - 1)]
    if halve:
        matrix = (matrix[::2] + matrix[1::2]) / 2
    k, x = np.arange(BLOCK)[:, None], np.arange(BLOCK)
    dct = np.cos((2 * x + 1) * k * np.pi / (2 * BLOCK)) * np.sqrt(2 / BLOCK)
    dct[0] /= np.sqrt(2)
    blocks = matrix.reshape(-1, BLOCK, side)
    return (dct @ blocks).reshape(-1, side)
