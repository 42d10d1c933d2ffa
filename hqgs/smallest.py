"""The smallest Gaussian that photos of a given resolution can show, world units."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs.camera import Camera, View
from hqgs.gaussians import Gaussians

MARGIN = 1.15  # of the half field of view: a Gaussian just outside the picture still reaches into it
NEAREST = 0.01  # view-space depth, as the rasterizer's near plane


def photo_pixels(means: Tensor, views: list[View]) -> Tensor:
    """The size of a pixel of the training view that sees each mean best, world units, [N].

    depth / focal length, the smallest over the views that have the mean in their picture (Mip-Splatting, Yu
    et al. 2024, equation 7). A mean that no view sees gets the median of the others; 0 if none sees any.
    """
    best = torch.full((len(means),), torch.inf, dtype=torch.float64)
    means = means.detach().double()
    for view in views:
        depth, seen = in_picture(means, view.camera)
        size = depth / max(view.camera.K[0, 0], view.camera.K[1, 1])
        best = torch.where(seen & (size < best), size, best)
    seen = torch.isfinite(best)
    best[~seen] = best[seen].median() if seen.any() else 0.0
    return best


def in_picture(means: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """View-space depths [N] of means [N, 3] (float64), and whether they are in the picture, bool [N]."""
    viewmat, K = torch.from_numpy(camera.viewmat), camera.K
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    seen = (
        (z > NEAREST)
        & (x.abs() * K[0, 0] < MARGIN * camera.width / 2 * z)
        & (y.abs() * K[1, 1] < MARGIN * camera.height / 2 * z)
    )
    return z, seen


def enlarge(gaussians: Gaussians, smallest: Tensor) -> Gaussians:
    """The Gaussians convolved with round ones of standard deviation `smallest` [N], world units.

    Mip-Splatting's 3D smoothing without its change of the opacities: they are trained with it.
    """
    scales = _Enlarge.apply(gaussians.scales, smallest)
    return Gaussians(**(gaussians.named() | {"scales": scales}))


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
