"""One view of the Gaussians as an image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hqgs import _rust
from hqgs.model.gaussians import Gaussians
from hqgs.model.rasterization import RasterizationMeta
from hqgs.scene.geometry import resized_camera
from hqgs.scene.scene import Camera


def render_view(
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int,
    background: Sequence[float],
    eps2d: float = _rust.EPS2D,
) -> tuple[Tensor, RasterizationMeta]:
    """Rasterize for one camera: the image [H, W, 3] (not clamped) and the rasterizer's meta data.

    `eps2d`: the low-pass filter, px^2.
    """
    images, _, meta = gaussians.rasterize(camera, sh_degree=sh_degree, background=background, eps2d=eps2d)
    return images.squeeze(0), meta  # the gradient of images[0] would be another image


@torch.no_grad()
def nearness_map(gaussians: Gaussians, camera: Camera, coarser: int) -> Tensor:
    """1 / expected depth in pixels `coarser` times as large, [ceil(H / coarser), ceil(W / coarser)].

    Where little is in the way of the light, the median of the rest; 0 where nothing is anywhere.
    """
    small = resized_camera(camera, -(-camera.width // coarser), -(-camera.height // coarser))
    depths, alphas, _ = gaussians.rasterize(small, gaussians.sh0[:, 0], render_mode="ED")
    near, solid = 1 / depths[0, ..., 0].clamp(min=_rust.NEAR_PLANE), alphas[0, ..., 0] > 0.5
    return torch.where(solid, near, near[solid].median() if solid.any() else 0.0)
