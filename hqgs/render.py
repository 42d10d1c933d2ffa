"""One view of the Gaussians as an image."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hqgs.camera import Camera
from hqgs.gaussians import Gaussians
from hqgs.rasterize import rasterization


def render_view(
    gaussians: Gaussians, camera: Camera, sh_degree: int, background: tuple[float, float, float]
) -> tuple[Tensor, dict[str, Any]]:
    """Rasterize for one camera: the image [H, W, 3] (not clamped) and the rasterizer's meta data."""
    # At degree 0 the higher harmonics are left out, so that they get no gradient full of zeros either.
    colors = (gaussians.sh0, gaussians.shN) if sh_degree else gaussians.sh0
    images, _, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.activated_scales(),
        gaussians.activated_opacities(),
        colors,
        torch.tensor(camera.viewmat[None]),
        torch.tensor(camera.K[None]),
        camera.width,
        camera.height,
        sh_degree=sh_degree,
        backgrounds=torch.tensor([background]),
    )
    return images[0], meta
