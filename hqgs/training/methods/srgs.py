"""SRGS, the super-resolution baseline: a fine render is judged at the resolution of the photos as well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.photos.formation import Separable
from hqgs.photos.pixels import as_floats
from hqgs.photos.resize import resize, resize_matrix
from hqgs.scene.scene import View
from hqgs.training.config import SRGSConfig
from hqgs.training.methods.base import Method, Target, photo_tensors
from hqgs.training.methods.photometric import photometric_loss


@dataclass(frozen=True)
class TiedTarget(Target):
    """The photo, and the low-resolution one with how to bring a render to its size."""

    low: Tensor  # [h, w, 3] float32
    low_mask: Tensor | None  # [h, w] bool, True where it counts
    down: Separable | None  # [H, W] to [h, w]; None: the photo itself is the tie


class SRGS(Method[TiedTarget]):
    """Super-Resolution 3D Gaussian Splatting (Feng et al. 2024, arXiv 2404.10318), without its network.

        loss = (1 - texture_weight) P(down(render), low) + texture_weight P(render, image)

    with P = 0.8 L1 + 0.2 (1 - SSIM). The first term is the paper's sub-pixel constraint: every view samples
    the scene at other places within a pixel of `low`, and together they fix the fine render. The second is
    its texture guidance: `image` is the super-resolved photo. It is bicubic unless a network made it
    (`restore_scene`; the paper uses SwinIR). Gaussians, densification and schedule are those of 3DGS.

    - The weights 0.4 (texture) and 0.6 (sub-pixel) are those that the authors' published training script
      names. It names them in a comment and trains on the texture term alone, which is not the paper's
      method.
    - `down` is antialiased bicubic resizing, the operator that the low-resolution photos are made with. The
      authors average blocks of pixels. With photos made by bicubic that would tie the render to a picture
      of another sharpness.
    - The paper has low-resolution photos only. A photo without `low` (noise, JPEG, blur) stands for both:
      shrunk by `own_factor` it is the tie, in full it is the texture. So coarse detail counts more, and
      the shrinking averages noise away. With `own_factor` 1 nothing is shrunk: the loss of such a view is
      that of 3DGS, bit for bit. 2 is the default because SRGS as 3DGS under another name would be no
      baseline, and the published figures of SRGS on noise and JPEG differ from those of 3DGS.
    - A pixel of `low` counts if every pixel of the photo that it is made from counts.
    """

    name = "srgs"

    def __init__(self, config: SRGSConfig) -> None:
        self.config = config
        self._operators: dict[tuple[int, ...], Separable] = {}  # by the sizes: H, W, h, w

    def prepare(self, view: View) -> TiedTarget:
        """ValueError names a training view whose `low` does not fit."""
        photo, mask = photo_tensors(view)
        camera, low = view.camera, view.low
        if low is None:
            factor = self.config.own_factor
            if factor == 1:
                return TiedTarget(photo, mask, photo, mask, None)
            image = as_floats(view.image)
            low = resize(image, -(-camera.height // factor), -(-camera.width // factor))
        _check_low(view, low)
        sizes = camera.height, camera.width, *low.shape[:2]
        if sizes not in self._operators:
            matrices = resize_matrix(sizes[0], sizes[2]), resize_matrix(sizes[1], sizes[3])
            self._operators[sizes] = Separable.of(*matrices)
        down = self._operators[sizes]
        low_mask = None if view.mask is None else torch.from_numpy(down.mask(view.mask))
        low_photo = torch.from_numpy(np.require(low, requirements=["C", "W"]))
        return TiedTarget(photo, mask, low_photo, low_mask, down)

    def loss(self, image: Tensor, target: TiedTarget) -> Tensor:
        texture = photometric_loss(image, target.photo, target.mask)
        if target.down is None:
            return texture
        low = target.down(image)
        subpixel = photometric_loss(low, target.low.to(low.dtype), target.low_mask)
        weight = self.config.texture_weight
        return (1 - weight) * subpixel + weight * texture


def _check_low(view: View, low: NDArray[Any]) -> None:
    height, width = view.camera.height, view.camera.width
    fits = low.ndim == 3 and low.shape[2] == 3 and 1 <= low.shape[0] <= height and 1 <= low.shape[1] <= width
    if low.dtype != np.float32 or not fits:
        raise ValueError(
            f"view {view.name!r}: low is {low.dtype} {list(low.shape)}, wanted float32 [h, w, 3] with h up "
            f"to {height} and w up to {width}, the camera's size"
        )
    if not np.isfinite(low).all():
        raise ValueError(f"view {view.name!r}: low holds NaN or Inf")
