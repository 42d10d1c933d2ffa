"""3D Gaussian Splatting, the baseline."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from hqgs.camera import View
from hqgs.gaussians import Gaussians
from hqgs.losses import photometric_loss
from hqgs.methods.base import photo_tensors


class ThreeDGS:
    """3D Gaussian Splatting (Kerbl et al. 2023, equation 7): 0.8 L1 + 0.2 D-SSIM on the Gaussians as is."""

    LAMBDA_DSSIM = 0.2

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        return gaussians

    def loss(self, render: Tensor, view: View) -> Tensor:
        image, mask = photo_tensors(view)
        return photometric_loss(render, image, mask=mask, lambda_dssim=self.LAMBDA_DSSIM)

    def param_groups(self) -> list[dict[str, Any]]:
        return []

    def state_dict(self) -> dict[str, Tensor]:
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if state:
            raise ValueError(f"3dgs has no state of its own, the checkpoint has {sorted(state)}")
