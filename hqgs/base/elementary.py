"""exp, log and rounding with the same bits on every make of CPU.

torch takes them from MKL, which rounds otherwise for other makers: runs on two makes of CPU would split
Gaussians in slightly different places. numpy's of float32 are its own; of float64 they go by the width of
vectors, those of long doubles are the C library's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable


def exp(x: Tensor) -> Tensor:
    """e^x of each element; gradients flow to `x`."""
    return _Exp.apply(x)


def log(x: Tensor) -> Tensor:
    """The natural logarithm of each element; gradients flow to `x`."""
    return _Log.apply(x)


def on_grid(values: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Values rounded to multiples of `step`, with one zero: a BLAS, too, rounds as the CPU's maker has it."""
    return np.round(values / step) * step + 0.0


def _by(function: np.ufunc, x: NDArray[Any]) -> NDArray[Any]:
    return function(x) if x.dtype == np.float32 else function(x, dtype=np.longdouble).astype(x.dtype)


class _Exp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        with np.errstate(all="ignore"):
            found = torch.as_tensor(_by(np.exp, x.numpy()))
        ctx.save_for_backward(found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_found: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (found,) = ctx.saved_tensors
        return v_found * found


class _Log(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        with np.errstate(all="ignore"):
            return torch.as_tensor(_by(np.log, x.numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_found: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (x,) = ctx.saved_tensors
        return v_found / x
