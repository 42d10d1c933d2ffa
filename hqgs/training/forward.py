"""The forward pass of a step: the render of a training view, and how far it is from the photo."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs.base.ranks import Ranks
from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.model.rasterization import RasterizationMeta
from hqgs.model.render import render_view
from hqgs.photos.pixels import floats
from hqgs.scene.scene import Camera, View
from hqgs.training.guard import Fault, bad_values, coming_gradient, gradient_fault
from hqgs.training.methods.base import Method, Target
from hqgs.training.overfitting import with_dropout
from hqgs.training.schedule import StepPlan, low_pass, smaller
from hqgs.training.state import TrainState


@dataclass(frozen=True)
class Step:
    """What a training step has seen."""

    loss: float  # of a view that this process has rendered
    render: Tensor  # its developed render, [H, W, 3], detached; of size 0 where this process rendered none
    view: View  # that view, of the size at which it was rendered; without one the step's first view


@dataclass(frozen=True)
class Gradients:
    """Of the views of one step."""

    step: Step
    faults: list[Fault | None]  # what was not finite, of each view
    measured: list[Tensor]  # what the method goes by after the step, of each view
    apply: Callable[[], None]  # moves the Gaussians, and notes what growth goes by


@dataclass(frozen=True)
class ForwardPass:
    """The forward pass at one training view."""

    plan: StepPlan
    view: View
    camera: Camera  # that was rasterized for
    render: Tensor  # [H, W, 3]
    meta: RasterizationMeta
    photo: Tensor  # the developed render, [H, W, 3]
    loss: Tensor
    measured: Tensor  # what the method goes by after the step, [K]
    pulls: list[Tensor]  # the gradient of the projected means, [1, N, 2], once it is there

    def backward(self, state: TrainState) -> Fault | None:
        """Compute the gradients of all that is trained, in place of those that are there; what is not finite
        of them or of the loss, if anything is."""
        state.optimizer.zero_grad()
        if math.isfinite(self.loss.detach()):
            of_render = coming_gradient(self.render)
            self.loss.backward()
            return gradient_fault(state.gaussians, state.optimizer, of_render)
        count = bad_values(self.view)
        none = torch.zeros(len(state.gaussians), dtype=torch.bool)
        return Fault("photo" if count else "loss", [], none, count)

    @property
    def step(self) -> Step:
        return Step(float(self.loss.detach()), self.photo.detach(), self.view)


class TrainingViews:
    """The training views of a run, as its method judges renders of them."""

    def __init__(
        self, views: Sequence[View], method: Method[Any], background: tuple[float, float, float]
    ) -> None:
        """ValueError, which names it, for a view that the method cannot use."""
        self.views = views
        self.method = method
        self.background = background
        with one_torch_thread():
            self.targets: list[Target] = [method.prepare(view) for view in views]
        self._small: dict[int, tuple[View, Target]] = {}

    def target(self, number: int, coarse: bool) -> tuple[View, Target]:
        """A view and its target, at full size or at the smaller one."""
        if not coarse:
            return self.views[number], self.targets[number]
        if number not in self._small:
            small = smaller(self.views[number])
            self._small[number] = small, self.method.prepare(small)
        return self._small[number]

    def at(self, plan: StepPlan, gaussians: Gaussians, seed: int) -> ForwardPass:
        """The forward pass that a plan asks for, of the Gaussians to rasterize, with a gradient history.

        `seed`: of the run; it tells which Gaussians drop out.
        """
        method, (view, target) = self.method, self.target(plan.view, plan.coarse)
        gaussians = with_dropout(gaussians, plan.dropout, seed, plan.iteration)
        shot = method.shot(view, target)
        eps2d = low_pass(plan.coarse)
        render, meta = render_view(gaussians, shot.camera, plan.degree, self.background, eps2d)
        pulls = coming_gradient(meta["means2d"])
        photo = shot.develop(render)
        image = method.compare(photo, target)
        loss = method.loss(image, target)
        measured = method.measured(image.detach(), target)
        return ForwardPass(plan, view, shot.camera, render, meta, photo, loss, measured, pulls)

    @torch.no_grad()
    def taken(self, gaussians: Gaussians, number: int, degree: int, coarse: bool = False) -> Tensor:
        """The photo of this number, [H, W, 3], as its camera takes `gaussians`, up to a degree."""
        view, target = self.target(number, coarse)
        shot = self.method.shot(view, target)
        render, _ = render_view(gaussians, shot.camera, degree, self.background, low_pass(coarse))
        return shot.develop(render)

    @torch.no_grad()
    def psnr(
        self, gaussians: Gaussians, numbers: Sequence[int], degree: int, coarse: bool, ranks: Ranks
    ) -> float:
        """Of training photos of these numbers as the method compares them, of `gaussians` to rasterize, up to
        a degree; known noise does not count, nor do photos whose masks leave nothing. NaN where all are such.
        """

        noise = self.method.noise

        def error(number: int) -> float | None:
            target = self.target(number, coarse)[1]
            image = self.method.compare(self.taken(gaussians, number, degree, coarse), target)
            difference = (image - floats(target.photo)).square()
            if target.mask is not None:
                image, difference = image[target.mask], difference[target.mask]
            if noise:  # nearer to black and white it is cut off
                difference = difference[(image - 0.5).abs() < 0.5 - 1.5 * noise]
            return float(difference.double().mean()) if len(difference) else None

        errors = [found for found in ranks.divide(numbers, error) if found is not None]
        if not errors:
            return math.nan
        left = float(np.mean(errors)) - noise**2
        return math.nan if left <= 0 < noise else -10 * math.log10(max(left, 1e-10))


def gradients_of_one(plan: StepPlan, training: TrainingViews, state: TrainState) -> Gradients:
    """Those of the view that a step takes; they stay where they came to be."""
    forward = training.at(plan, training.method.modulate(state.gaussians), state.densifier.seed)
    fault = forward.backward(state)

    def apply() -> None:
        if plan.observes:
            (pulls,), radii, camera = forward.pulls[0], forward.meta["radii"][0], forward.view.camera
            state.densifier.observe(pulls, radii, camera.width, camera.height)
        state.optimizer.step()

    return Gradients(forward.step, [fault], [forward.measured], apply)
