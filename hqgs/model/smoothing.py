"""The smallest Gaussian that photos of a given resolution can show, world units."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs.model.gaussians import Gaussians


def enlarge(gaussians: Gaussians, smallest: Tensor) -> Gaussians:
    """The Gaussians convolved with round ones of standard deviation `smallest` [N], world units.

    Mip-Splatting's 3D smoothing without its change of the opacities: they are trained with it.
    """
    scales = _Enlarge.apply(gaussians.scales, smallest)
    return gaussians.like(gaussians.named() | {"scales": scales})


class _Enlarge(torch.autograd.Function):
    """log sqrt(exp(2 scale) + smallest^2). In place where it can be: each step does it for all Gaussians."""

    @staticmethod
    def forward(ctx: Any, scales: Tensor, smallest: Tensor) -> Tensor:
        own = torch.exp(2 * scales)  # variances
        variances = own + smallest.square()[:, None]
        ctx.save_for_backward(own.div_(variances))
        return variances.log_().mul_(0.5)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_scales: Tensor
    ) -> tuple[Tensor, None]:
        (share,) = ctx.saved_tensors
        return v_scales * share, None
