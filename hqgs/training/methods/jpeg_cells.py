"""The quantisation cells of a JPEG photo, as a loss: what the file leaves open costs nothing.

A JPEG file tells of each DCT coefficient only the nearest multiple of its step. A render whose coefficient
lies within half a step of it would give the same file, so a pixel loss, which pulls it to the decoded
photo, paints the codec's blocks. The views fill the cells: each photo is quantised in another place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust
from hqgs.photos.formation import Separable
from hqgs.photos.jpeg import Tables

BLOCK = 8
# R, G, B to Y, Cb, Cr (ITU-T T.871, without the offset of the chroma, which no difference sees).
TO_YCBCR = ((0.299, 0.587, 0.114), (-0.168735892, -0.331264108, 0.5), (0.5, -0.418687589, -0.081312411))


@dataclass(frozen=True)
class Coefficients:
    """DCT coefficients on the scale where white is 1."""

    luma: Tensor  # [rows, columns, 1], padded to whole blocks
    chroma: Tensor  # [rows, columns, 2] of the channels at half the size


class JpegCells:
    """Distance of a picture to the cells of a JPEG photo with 4:2:0 chroma."""

    def __init__(self, tables: Tables, height: int, width: int) -> None:
        """`height`, `width`: of the photo, px."""
        to_ycbcr = np.array(TO_YCBCR)
        rows, columns = (_analysis(side, halve=False) for side in (height, width))
        self._luma = Separable.of(rows, columns, to_ycbcr[:1])
        rows, columns = (_analysis(side, halve=True) for side in (height, width))
        self._chroma = Separable.of(rows, columns, to_ycbcr[1:])
        luma, chroma = (torch.tensor(table).reshape(BLOCK, BLOCK) / 255 for table in tables)
        self._luma_steps = _tile(luma, self._luma, 1)
        self._chroma_steps = _tile(chroma, self._chroma, 2)
        self._pixels = height * width

    def coefficients(self, image: Tensor) -> Coefficients:
        """Of a picture [H, W, 3], white at 1; differentiable."""
        return Coefficients(self._luma(image), self._chroma(image))

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
            centres: of the photo, of the image's dtype.
        """
        c, scale = self.coefficients(image), 1 / (3 * self._pixels)
        luma = _Distance.apply(c.luma, centres.luma, self._luma_steps, scale)
        return luma + _Distance.apply(c.chroma, centres.chroma, self._chroma_steps, scale)


class _Distance(torch.autograd.Function):
    """`scale` times the sum of relu(|c - centre| - steps / 2). The gradient comes with the value."""

    @staticmethod
    def forward(ctx: Any, c: Tensor, centres: Tensor, steps: Tensor, scale: float) -> Tensor:
        x, y, widths = (t.detach().contiguous().numpy() for t in (c, centres, steps.to(c)))
        value, grad = _rust.cell_distance(x, y, widths, scale, ctx.needs_input_grad[0])
        if grad is not None:
            ctx.save_for_backward(torch.from_numpy(grad).view(c.shape))
        return c.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_distance: Tensor
    ) -> tuple[Tensor, None, None, None]:
        (grad,) = ctx.saved_tensors
        return v_distance * grad, None, None, None


def _nearest(c: Tensor, steps: Tensor) -> Tensor:
    return torch.round(c / steps) * steps


def _tile(steps: Tensor, operator: Separable, channels: int) -> Tensor:
    rows, columns = (side // BLOCK for side in operator.size)
    return steps.repeat(rows, columns)[..., None].repeat(1, 1, channels)


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
