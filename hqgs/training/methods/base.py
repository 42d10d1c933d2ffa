"""What a method is: what is rasterized, and how a render is judged. The training loop is the same for all.

To add one: derive a class from `Method`, give it a name and a line of text in `METHODS` (config.py), and its
maker under the same name in `MAKERS` (methods/__init__.py). `tests/example_method.py` is the smallest one
with a tensor of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import View
from hqgs.training.methods.cameras import LearnedCamera, Shot, no_shot
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.plan import Facts
from hqgs.training.state import TrainState


@dataclass(frozen=True)
class Target:
    """What renders of one view are compared with. Methods add to it what else they need of the view."""

    photo: Tensor  # [h, w, 3], uint8 or float with white at 1
    mask: Tensor | None  # [h, w] bool, True where the photo counts; None: everywhere


T = TypeVar("T", bound=Target)


class Method(Generic[T]):
    """The replaceable part of a training step.

    As it is here it rasterizes the Gaussians as they are, compares the render with the photo, and decides
    nothing: a method has what it does otherwise, and its `loss`.

    The trainer calls `prepare` for each training view, `facts` once, and `start` for the first Gaussians. A
    step is, for each of its views, `modulate`, `shot`, rasterization, the shot's `develop`, `compare`, `loss`
    and `measured`, which change nothing; then Adam, `rows_changed` where Gaussians came or went, and
    `after_step`.
    """

    name: str
    as_photographed: bool = False  # renders are compared with photos as they are, of any size
    noise: float = 0.0  # standard deviation of the photos' noise as far as it is known, where 1 is white

    @property
    def rate_left(self) -> float:
        """Share of the Gaussians' learning rates that the next step is to take, 0..1."""
        return 1.0

    def prepare(self, view: View) -> T:
        """What renders of a training view are compared with. ValueError, which names it, for a bad one."""
        return cast(T, Target(*photo_tensors(view)))

    def facts(self, facts: Facts, targets: Sequence[T]) -> Facts:
        """`facts` with what the method's part of the plan goes by; `targets`: of all training views."""
        return replace(facts, as_photographed=self.as_photographed)

    def start(self, gaussians: Gaussians, iterations: int) -> Gaussians:
        """Those that are trained for so many iterations, of the first ones as the plan has them."""
        return gaussians

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians to rasterize, differentiable in the trained ones and in the method's own tensors.

        The number and order of the Gaussians stay the same.
        """
        return gaussians

    def shot(self, view: View, target: T) -> Shot:
        """The camera to rasterize for, and what makes the render a photo of the view's size."""
        return no_shot(view)

    def compare(self, render: Tensor, target: T) -> Tensor:
        """What of a developed render [H, W, 3], not clamped, is compared with the photo, [h, w, 3]."""
        return render

    def loss(self, image: Tensor, target: T) -> Tensor:
        """Scalar loss of what `compare` gave."""
        raise NotImplementedError

    def rows_changed(self, state: TrainState, parents: Tensor) -> None:
        """Gaussians were added or removed: row i stems from row `parents[i]` of those before, [N]."""

    def measured(self, image: Tensor, target: T) -> Tensor:
        """What `after_step` is to know of the image that the loss is of: a few numbers, float64 [K]."""
        return torch.zeros(0, dtype=torch.float64)

    def after_step(self, state: TrainState, view: View, seen: Tensor) -> None:
        """What ages, and what is decided for the next step; for each view of the step, in their order."""

    def learned(self) -> list[LearnedCamera]:
        """What was learned of each training photo's camera; empty where nothing is learned of any."""
        return []

    def param_groups(self) -> list[dict[str, Any]]:
        """The method's own trained tensors as Adam groups: {"name", "params", "lr"}; names are unique."""
        return []

    def rates(self, part: float) -> dict[str, float]:
        """Learning rates of its groups, by name, where they change: `part` of the run is done, 0..1."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that a checkpoint must hold of the method, beside the Gaussians and the moments."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take the values of `state_dict` over, into the tensors that `param_groups` gave out."""
        if state:
            raise ValueError(f"{self.name} has no state of its own, the checkpoint has {sorted(state)}")


def photo_tensors(view: View) -> tuple[Tensor, Tensor | None]:
    """A view's photo [H, W, 3] uint8 and mask [H, W] bool. They share the arrays' memory where torch can."""

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.require(array, requirements=["C", "W"]))  # torch warns of read-only memory

    return tensor(view.image), None if view.mask is None else tensor(view.mask)


class ThreeDGS(Method[Target]):
    """3D Gaussian Splatting (Kerbl et al. 2023, equation 7): 0.8 L1 + 0.2 D-SSIM on the Gaussians as is."""

    name = "3dgs"
    as_photographed = True

    def loss(self, image: Tensor, target: Target) -> Tensor:
        return photometric_loss(image, target.photo, target.mask)
