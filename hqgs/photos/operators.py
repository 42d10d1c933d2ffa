"""Linear operators on pictures that are a banded matrix per axis: resizing, blur, block transforms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust

Taps = tuple[tuple[int, int, float], ...]


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


@dataclass(frozen=True)
class Kernel:
    """Convolution with a kernel of odd size, [H, W, C] to [H, W, C].

    The border mirrors the picture without repeating the edge, as the degradations do. A sum of shifted
    pictures: a motion's kernel is mostly zeros, and a small disc has few weights.
    """

    size: tuple[int, int]  # height and width of what goes in and comes out
    reach: tuple[int, int]  # rows and columns to each side
    taps: Taps  # row and column of the padded picture that a pixel starts from, and the weight

    @classmethod
    def of(cls, kernel: NDArray[np.float64], height: int, width: int) -> Kernel:
        """For pictures of this size. ValueError if they are smaller than the kernel's reach allows."""
        reach = kernel.shape[0] // 2, kernel.shape[1] // 2
        if reach[0] >= height or reach[1] >= width:
            raise ValueError(
                f"a kernel of {kernel.shape[1]} x {kernel.shape[0]} px is too large for a photo of "
                f"{width} x {height} px"
            )
        flipped = kernel[::-1, ::-1]
        taps = tuple((int(i), int(j), float(flipped[i, j])) for i, j in np.argwhere(flipped))
        return cls((height, width), reach, taps)

    def __call__(self, image: Tensor) -> Tensor:
        """Differentiable once in the image; the sums have one order."""
        return _ApplyKernel.apply(image, self)

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[H, W], True where no pixel that is left out, in `mask` [H, W], has a weight."""
        rows, columns = self.sources()
        padded = mask[rows][:, columns]
        height, width = self.size
        counts = np.ones(self.size, bool)
        for i, j, _ in self.taps:
            counts &= padded[i : i + height, j : j + width]
        return counts

    def sources(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of the picture that make up the padded one."""
        rows, columns = (
            np.pad(np.arange(n), r, mode="reflect") for n, r in zip(self.size, self.reach, strict=True)
        )
        return rows, columns


class _ApplyKernel(torch.autograd.Function):
    """The operator is linear: its gradient is the transposed operator."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, kernel: Kernel) -> Tensor:
        ctx.kernel = kernel
        rows, columns = (torch.from_numpy(source) for source in kernel.sources())
        padded = image.index_select(0, rows).index_select(1, columns)
        height, width = kernel.size
        out = torch.zeros_like(image, memory_format=torch.contiguous_format)
        for i, j, weight in kernel.taps:
            out.add_(padded[i : i + height, j : j + width], alpha=weight)
        return out

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_out: Tensor
    ) -> tuple[Tensor, None]:
        kernel: Kernel = ctx.kernel
        rows, columns = (torch.from_numpy(source) for source in kernel.sources())
        height, width = kernel.size
        v_padded = v_out.new_zeros(len(rows), len(columns), v_out.shape[2])
        for i, j, weight in kernel.taps:
            v_padded[i : i + height, j : j + width].add_(v_out, alpha=weight)
        v_wide = v_out.new_zeros(height, len(columns), v_out.shape[2]).index_add_(0, rows, v_padded)
        return v_out.new_zeros(v_out.shape).index_add_(1, columns, v_wide), None
