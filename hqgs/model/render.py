"""One view of the Gaussians as an image."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs import _rust
from hqgs.model.gaussians import Gaussians
from hqgs.model.rasterization import RasterizationMeta
from hqgs.scene.geometry import resized_camera
from hqgs.scene.scene import Camera, View

# As `render_view` renders: near, far, radius_clip, eps2d.
OPTIONS = (_rust.NEAR_PLANE, _rust.FAR_PLANE, 0.0, _rust.EPS2D)


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


def blending_weights(gaussians: Gaussians, camera: Camera) -> Tensor:
    """The largest blending weight T alpha of each Gaussian over the pixels of one view, [N].

    The weight is the factor of the Gaussian's colour in the pixel: its alpha times the transmittance in front
    of it, with the floor of alpha and the early stop of `hqgs.rasterization` (docs/conventions.md). 0 for a
    Gaussian that no pixel blends. No colours are evaluated: a Gaussian whose colour alone is not finite is
    not culled here.

    Returns:
        [N], in [0, 0.99], the dtype of the Gaussians, without a gradient history. Same bits for any number
        of threads.
    """
    return _largest(gaussians, [(camera, None)])


def largest_weights(gaussians: Gaussians, views: Sequence[View]) -> Tensor:
    """The maximum of `blending_weights` over views, [N]. Pixels where a view's mask is False do not count.

    Raises:
        ValueError: a mask that does not have the size of its view's camera.
    """
    return _largest(gaussians, [(view.camera, view.mask) for view in views])


@torch.no_grad()
def _largest(gaussians: Gaussians, views: Iterable[tuple[Camera, NDArray[np.bool_] | None]]) -> Tensor:
    tensors = gaussians.means, gaussians.quats, gaussians.activated_scales(), gaussians.activated_opacities()
    means, quats, scales, opacities = (tensor.contiguous().numpy() for tensor in tensors)
    no_colors = np.empty((len(gaussians), 0), means.dtype)
    largest = torch.zeros_like(gaussians.opacities)
    options = (*OPTIONS, gaussians.antialiased, False)  # not to be differentiated
    for camera, mask in views:
        viewmat, K = (np.ascontiguousarray(m[None], np.float64) for m in (camera.viewmat, camera.K))
        size = camera.width, camera.height
        frame, *_ = _rust.project_forward(
            means, quats, scales, opacities, no_colors, None, viewmat, K, *size, options, None
        )
        counted = None if mask is None else np.ascontiguousarray(mask[None], bool).view(np.uint8)
        weights = _rust.blending_weights(frame, counted, largest.dtype == torch.float64)
        torch.maximum(largest, torch.from_numpy(weights), out=largest)
    return largest
