"""What a method is: what is rasterized and which loss judges it. The training loop is the same for all."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.model.first_points import Colors, Points
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import floats
from hqgs.scene.scene import Scene, View
from hqgs.training.config import AUTO
from hqgs.training.methods.photometric import photometric_loss

if TYPE_CHECKING:
    from hqgs.training.config import TrainConfig


class Method(Protocol):
    """The replaceable part of a training step."""

    @property
    def as_photographed(self) -> bool:
        """Whether a render is compared with the photo as it is, of any size: nothing has degraded it."""
        ...

    @property
    def noise(self) -> float:
        """Standard deviation of the photos' noise as far as it is known, where 1 is white."""
        ...

    @property
    def rate_left(self) -> float:
        """Share of the Gaussians' learning rates that the next step is to take, 0..1."""
        ...

    def compared(self, render: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor | None]:
        """What of a render [H, W, 3] is compared with what of the photo (float), and the mask of the two."""
        ...

    def adapt(self, config: TrainConfig) -> TrainConfig:
        """The configuration to train with: the given one, with what the method decides for this scene."""
        ...

    def first_points(self, scene: Scene, config: TrainConfig) -> tuple[Points, Colors]:
        """The points [N, 3] and colours [N, 3] to start from; `config` is what `adapt` gave."""
        ...

    def left_out(self) -> list[tuple[str, str]]:
        """Parts of the method that this scene does not need: (what, why)."""
        ...

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians to rasterize, differentiable in the trained ones and in the method's own tensors.

        The number and order of the Gaussians stay the same.
        """
        ...

    def rows_changed(self) -> None:
        """Gaussians were added or removed: what was known of each of them is of no use any more."""
        ...

    def loss(self, render: Tensor, view: View) -> Tensor:
        """Scalar loss of a render [H, W, 3] (float, not clamped) against a training view."""
        ...

    def param_groups(self) -> list[dict[str, Any]]:
        """The method's own trained tensors as Adam groups: {"name", "params", "lr"}; names are unique."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that a checkpoint must hold of the method, beside the Gaussians and the moments."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take the values of `state_dict` over, into the tensors that `param_groups` gave out."""
        ...


class Plain:
    """The parts of a method that has no tensors of its own and decides nothing about the training."""

    name: str
    as_photographed = False
    noise = 0.0
    rate_left = 1.0

    def compared(self, render: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor | None]:
        photo, mask = photo_tensors(view)
        return render, floats(photo), mask

    def adapt(self, config: TrainConfig) -> TrainConfig:
        return replace(config, method=self.name) if config.method == AUTO else config

    def first_points(self, scene: Scene, config: TrainConfig) -> tuple[Points, Colors]:
        return scene.points, scene.point_colors

    def left_out(self) -> list[tuple[str, str]]:
        return []

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        return gaussians

    def rows_changed(self) -> None:
        pass

    def param_groups(self) -> list[dict[str, Any]]:
        return []

    def state_dict(self) -> dict[str, Tensor]:
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if state:
            raise ValueError(f"{self.name} has no state of its own, the checkpoint has {sorted(state)}")


def photo_tensors(view: View) -> tuple[Tensor, Tensor | None]:
    """A view's photo [H, W, 3] uint8 and mask [H, W] bool. They share the arrays' memory where torch can."""

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.require(array, requirements=["C", "W"]))  # torch warns of read-only memory

    return tensor(view.image), None if view.mask is None else tensor(view.mask)


class ThreeDGS(Plain):
    """3D Gaussian Splatting (Kerbl et al. 2023, equation 7): 0.8 L1 + 0.2 D-SSIM on the Gaussians as is."""

    name = "3dgs"
    as_photographed = True
    LAMBDA_DSSIM = 0.2

    def loss(self, render: Tensor, view: View) -> Tensor:
        image, mask = photo_tensors(view)
        return photometric_loss(render, image, mask=mask, lambda_dssim=self.LAMBDA_DSSIM)
