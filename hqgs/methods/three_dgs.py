"""3D Gaussian Splatting, the baseline."""

from __future__ import annotations

from torch import Tensor

from hqgs.camera import View
from hqgs.losses import photometric_loss
from hqgs.methods.base import Plain, photo_tensors


class ThreeDGS(Plain):
    """3D Gaussian Splatting (Kerbl et al. 2023, equation 7): 0.8 L1 + 0.2 D-SSIM on the Gaussians as is."""

    name = "3dgs"
    as_photographed = True
    LAMBDA_DSSIM = 0.2

    def loss(self, render: Tensor, view: View) -> Tensor:
        image, mask = photo_tensors(view)
        return photometric_loss(render, image, mask=mask, lambda_dssim=self.LAMBDA_DSSIM)
