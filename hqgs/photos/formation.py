"""How a degraded photo comes from a clean picture: the linear part, as an operator on renders.

A loss that compares the degraded render with the photo lets the scene stay sharp, where a loss on the render
itself would teach it the blur. Shrinking and Gaussian blur are separable, so each is a matrix per axis;
defocus and motion are small kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias, Union

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust
from hqgs.photos.formula import Degradation, check_formation, small_side
from hqgs.photos.resize import resize_matrix

Taps = tuple[tuple[int, int, float], ...]
GOLDEN = math.pi * (3 - math.sqrt(5))  # radians from one seed of a sunflower, which fills a disc, to the next
KERNEL_REACH = 4  # sigmas at which the Gaussian kernel ends


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


@dataclass(frozen=True)
class Sequence:
    """Operators one after the other, each a linear map of pictures, [H, W, C] to [h, w, C]."""

    operators: tuple[Operator, ...]  # at least one

    @property
    def size(self) -> tuple[int, int]:
        return self.operators[-1].size

    def __call__(self, image: Tensor) -> Tensor:
        for operator in self.operators:
            image = operator(image)
        return image

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        for operator in self.operators:
            mask = operator.mask(mask)
        return mask


Operator: TypeAlias = Union[Separable, Kernel, Sequence]  # noqa: UP007


def formation(
    degradation: Degradation, height: int, width: int, direction: float | None = None
) -> Operator | None:
    """The linear steps of a degradation, for renders of `height` x `width` px.

    `direction` of the motion in radians from x towards y (down); without it motion is passed over, as are
    noise and JPEG. None where no step is left. ValueError where a kernel is too large for the render, or for
    a step that has no operator (`check_formation`).
    """
    operators: list[Operator] = []
    matrices: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # of the separable steps in a row
    size = height, width

    def close() -> None:
        nonlocal matrices
        if matrices is not None:
            operators.append(Separable.of(*matrices))
            matrices = None

    for step in check_formation(degradation).for_width(width, height).steps:
        value = step.value or 0.0
        if step.kind in ("blur", "lowres"):
            if step.kind == "blur":
                axes = tuple(blur_matrix(n, value) for n in size)
            else:
                axes = tuple(resize_matrix(n, small_side(n, int(value))) for n in size)
            size = len(axes[0]), len(axes[1])
            matrices = (
                (axes[0], axes[1]) if matrices is None else (axes[0] @ matrices[0], axes[1] @ matrices[1])
            )
        elif step.kind == "defocus":
            close()
            operators.append(Kernel.of(disc_kernel(value), *size))
        elif step.kind == "motion" and direction is not None:
            close()
            operators.append(Kernel.of(motion_kernel(value, direction), *size))
    close()
    if not operators:
        return None
    return operators[0] if len(operators) == 1 else Sequence(tuple(operators))


def blur_matrix(size: int, sigma: float) -> NDArray[np.float64]:
    """The matrix [size, size] of a Gaussian blur of `sigma` px along one axis, as the degradation has it.

    Sampled, ends at 4 sigma, sums to 1; the picture is mirrored at its border without repeating the edge.
    """
    reach = int(np.ceil(KERNEL_REACH * sigma))
    offsets = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
    kernel /= kernel.sum()
    source = np.pad(np.arange(size), reach, mode="reflect")
    matrix = np.zeros((size, size))
    for k, weight in enumerate(kernel):
        matrix[np.arange(size), source[k : k + size]] += weight
    return matrix


def disc_kernel(radius: float) -> NDArray[np.float64]:
    """A filled disc of `radius` px (defocus), square and of odd size, sum 1. kornia has none.

    The rim is antialiased: each pixel counts with the share of its area that lies in the disc, to 1e-3.
    """
    reach = math.ceil(radius + 0.5) - 1
    columns = np.arange(-reach, reach + 1)
    heights = columns[:, None] + (np.arange(64) + 0.5) / 64 - 0.5  # 64 lines through each row of pixels
    half_chords = np.sqrt(np.maximum(radius**2 - heights**2, 0))[..., None]
    left, right = (np.clip(end, columns - 0.5, columns + 0.5) for end in (-half_chords, half_chords))
    kernel = (right - left).mean(axis=1)
    kernel += kernel.T
    return kernel / kernel.sum()


def motion_kernel(length: float, angle: float) -> NDArray[np.float64]:
    """A straight line of `length` px through the centre, square and of odd size, sum 1.

    Convolving with it is the mean of the photo over shifts, by bilinear interpolation, along `length` px in
    the direction `angle` (radians from x towards y, which points down). The integral is exact. Not kornia's
    motion kernel: that one takes odd whole lengths only, and turns a row of pixels, which thins the line.
    """
    along = np.array([math.cos(angle), math.sin(angle)]) * length / 2
    reach = math.ceil(np.abs(along).max()) + 1
    # Between the places where the line crosses a row or column of pixel centres, the bilinear weights are
    # quadratic in the position, for which two Gauss points per stretch are exact.
    ends = [np.array([-1.0, 1.0])]
    ends += [np.arange(-reach, reach + 1) / half for half in along if abs(half) > 1e-9]
    breaks = np.unique(np.concatenate(ends).clip(-1, 1))
    middles, halves = (breaks[1:] + breaks[:-1]) / 2, np.diff(breaks) / 2
    at = np.concatenate([middles - halves / math.sqrt(3), middles + halves / math.sqrt(3)])
    weights = np.concatenate([halves, halves]) / 2

    x, y = at * along[0], at * along[1]
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for row in (0, 1):
        for column in (0, 1):
            share = (1 - np.abs(x - left - column)) * (1 - np.abs(y - top - row))
            np.add.at(kernel, (top + row + reach, left + column + reach), weights * share)
    return kernel / kernel.sum()
