"""Methods: what is rasterized and which loss judges it. The training loop is the same for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.camera import Scene, View
from hqgs.gaussians import Gaussians
from hqgs.losses import photometric_loss


class Method(Protocol):
    """The replaceable part of a training step."""

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians to rasterize, differentiable in the trained ones and in the method's own tensors.

        The number and order of the Gaussians stay the same.
        """
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


METHODS: dict[str, Callable[[Scene, int], Method]] = {"3dgs": lambda scene, seed: ThreeDGS()}


def check_method(name: str) -> None:
    """ValueError, which lists the methods there are, for an unknown name."""
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; the methods are: {', '.join(METHODS)}")


def make_method(name: str, scene: Scene, seed: int) -> Method:
    """The method of this name for a scene; ValueError for an unknown name."""
    check_method(name)
    return METHODS[name](scene, seed)


def photo_tensors(view: View) -> tuple[Tensor, Tensor | None]:
    """A view's photo [H, W, 3] uint8 and mask [H, W] bool. They share the arrays' memory where torch can."""

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.require(array, requirements=["C", "W"]))  # torch warns of read-only memory

    return tensor(view.image), None if view.mask is None else tensor(view.mask)
