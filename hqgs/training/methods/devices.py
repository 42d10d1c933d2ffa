"""What the cameras that took the photos do to all of them, learned with the scene: vignetting and response.

See `hqgs.photos.look` for the model. Photos cannot tell the mean of the responses, which stays 0, nor how
bright the scene is where lenses are dark: it is shown as the mean camera has it, with bright corners, and as
bright as the photos are in the mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.diagnosis.devices import Devices
from hqgs.photos.look import as_a_lens, as_responses, darken, falloff, respond, squared_radii
from hqgs.scene.scene import Camera

MEAN_SQUARES = 1 / 3, 0.16  # of r^2 and r^4 over a picture, the latter 0.156 (a square) to 0.168 (16:9)
KEPT = 8  # maps of squared radii; photos may each have a camera of their own


class LearnedDevices:
    """The cameras of a scene's training photos."""

    def __init__(self, first: Devices, vignetting: bool, response: bool) -> None:
        """`vignetting` and `response`: which of them is learned; what is not does nothing."""
        self._of_photo = first.of_photo
        self._vignetting = _trained(first.vignetting if vignetting else [])
        self._response = _trained(first.response if response else [])
        counts = np.bincount(first.of_photo[first.of_photo >= 0], minlength=len(first))
        self._shares = torch.from_numpy(counts / max(counts.sum(), 1))
        self._told = counts.sum() / max(len(first.of_photo), 1)  # share of the photos that have a camera
        self._squares = lru_cache(KEPT)(_squares)
        self.center()

    def level(self) -> Tensor:
        """The mean of the logarithm of what lenses keep from photos: gains beside it leave their mean."""
        if not self._vignetting:
            return torch.zeros((), dtype=torch.float64)
        means = torch.stack([*self._vignetting]) @ torch.tensor(MEAN_SQUARES, dtype=torch.float64)
        return self._told * (self._shares * means).sum()

    def develop(self, number: int, camera: Camera, taken: Tensor) -> Tensor:
        """The photo of this number of what was taken without its camera's faults, [H, W, 3]."""
        device = int(self._of_photo[number])
        if device < 0:
            return taken
        planes = taken.permute(2, 0, 1).contiguous()  # a factor of a channel, or of a pixel, is quicker so
        if self._vignetting:
            height, width = taken.shape[:2]
            center = float(camera.K[0, 2]), float(camera.K[1, 2])
            squares = self._squares(height, width, center, taken.dtype)
            planes = darken(planes, falloff(squares, self._vignetting[device].to(taken.dtype)))
        if self._response:
            planes = respond(planes, self._response[device])
        return planes.permute(1, 2, 0).contiguous()

    @torch.no_grad()
    def center(self) -> None:
        """What photos cannot tell stays, light falls towards corners, and responses rise: after each step."""
        for vignetting in self._vignetting:
            vignetting.copy_(torch.from_numpy(as_a_lens(vignetting.numpy())))
        if not self._response:
            return
        each = torch.stack([*self._response])
        each -= (self._shares[:, None, None] * each).sum(0)
        for response, value in zip(self._response, as_responses(each.numpy()), strict=True):
            response.copy_(torch.from_numpy(value))

    def learned(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vignetting [2] and response [2, 3] of the photo's camera."""
        device = int(self._of_photo[number])
        vignetting, response = np.zeros(2), np.zeros((2, 3))
        if device >= 0 and self._vignetting:
            vignetting = self._vignetting[device].detach().numpy().copy()
        if device >= 0 and self._response:
            response = self._response[device].detach().numpy().copy()
        return vignetting, response

    def param_groups(self) -> list[dict[str, Any]]:
        return groups_of(self._named())

    def state_dict(self) -> dict[str, Tensor]:
        return state_of(self._named())

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        load_into(self._named(), state)

    def _named(self) -> dict[str, list[Tensor]]:
        return {"vignetting": self._vignetting, "response": self._response}


def _squares(height: int, width: int, center: tuple[float, float], dtype: torch.dtype) -> Tensor:
    """r^2 of each pixel of photos with this principal point, [H, W]."""
    K = np.eye(3)
    K[:2, 2] = center
    return torch.from_numpy(squared_radii(height, width, K)).to(dtype)


def groups_of(named: Mapping[str, list[Tensor]]) -> list[dict[str, Any]]:
    """Groups of an optimizer, of the tensors that are trained under each name; none where there are none."""
    return [
        {"name": name, "params": params, "lr": 0.0, "betas": (0.9, 0.99)}
        for name, params in named.items()
        if params
    ]


def state_of(named: Mapping[str, list[Tensor]]) -> dict[str, Tensor]:
    """The tensors as a checkpoint names them."""
    return {f"{name}.{k}": value.detach() for name, values in named.items() for k, value in enumerate(values)}


@torch.no_grad()
def load_into(named: Mapping[str, list[Tensor]], state: dict[str, Tensor]) -> None:
    """The values of `state_of` into these tensors."""
    for name, values in named.items():
        for k, value in enumerate(values):
            value.copy_(state[f"{name}.{k}"])


def _trained(values: Iterable[NDArray[np.float64]]) -> list[Tensor]:
    return [torch.from_numpy(value.copy()).requires_grad_() for value in values]
