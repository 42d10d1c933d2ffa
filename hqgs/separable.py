"""Linear operators on pictures that are a banded matrix per axis: resizing, blur, block transforms."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust


class Separable:
    """rows @ channel @ columns^T for each channel of a picture: [H, W, C] to [h, w, C].

    Only the band of each row, from its first weight to its last, is multiplied: the dense product for a
    photo of 1920 x 1080 px takes seconds.
    """

    def __init__(self, operator: _rust.Separable) -> None:
        self._operator = operator

    @classmethod
    def of(
        cls,
        rows: NDArray[np.float64],
        columns: NDArray[np.float64],
        channels: NDArray[np.float64] | None = None,
    ) -> Separable:
        """From dense matrices [h, H], [w, W] and, where it also mixes the channels, [D, C].

        ValueError names a matrix that is none.
        """
        dense = np.ascontiguousarray
        mixing = None if channels is None else dense(channels, np.float64)
        return cls(_rust.Separable(dense(rows, np.float64), dense(columns, np.float64), mixing))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of what comes out."""
        return self._operator.size

    def __call__(self, image: Tensor) -> Tensor:
        """Of a picture [H, W, C], float32 or float64; differentiable once in it.

        The sums have one order, in the picture's dtype. What is not finite spoils the pixels that it reaches.
        ValueError for another shape or dtype.
        """
        if image.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"image: must be float32 or float64, got {image.dtype}")
        return _Apply.apply(image, self._operator)

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[h, w], True where no pixel that is left out, in `mask` [H, W], has a weight."""
        left_out = (~mask).astype(np.float32)[..., None]
        return self._operator.apply_absolute(left_out).reshape(self.size) == 0


class _Apply(torch.autograd.Function):
    """The operator is linear: its gradient is the transposed operator."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, operator: _rust.Separable) -> Tensor:
        ctx.operator, ctx.shape = operator, image.shape
        out = operator.apply(image.detach().contiguous().numpy(), False)
        return torch.from_numpy(out).view(*operator.size, -1)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_out: Tensor
    ) -> tuple[Tensor, None]:
        v_image = ctx.operator.apply(v_out.contiguous().numpy(), True)
        return torch.from_numpy(v_image).view(ctx.shape), None
