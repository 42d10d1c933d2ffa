"""The forward pass of a step: the render of a training view, and how far it is from the photo."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from hqgs.training.adam import Adam
from hqgs.training.guard import Fault, bad_values, coming_gradient, gradient_fault
from hqgs.training.methods.base import Method, Target
from hqgs.training.schedule import StepPlan, low_pass, smaller


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

    def backward(self, trained: Gaussians, optimizer: Adam) -> Fault | None:
        """Compute the gradients of all that is trained; what is not finite of them or of the loss, if
        anything is."""
        if math.isfinite(self.loss.detach()):
            of_render = coming_gradient(self.render)
            self.loss.backward()
            return gradient_fault(trained, optimizer, of_render)
        count = bad_values(self.view)
        none = torch.zeros(len(trained), dtype=torch.bool)
        return Fault("photo" if count else "loss", [], none, count)


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

    def at(self, plan: StepPlan, gaussians: Gaussians) -> ForwardPass:
        """The forward pass that a plan asks for, of the Gaussians to rasterize, with a gradient history."""
        method, (view, target) = self.method, self.target(plan.view, plan.coarse)
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
    def psnr(
        self, gaussians: Gaussians, numbers: Sequence[int], degree: int, coarse: bool, ranks: Ranks
    ) -> float:
        """Of training photos of these numbers as the method compares them, of `gaussians` to rasterize, up to
        a degree; known noise does not count, nor do photos whose masks leave nothing. NaN where all are such.
        """

        def error(number: int) -> float | None:
            view, target = self.target(number, coarse)
            shot = self.method.shot(view, target)
            render, _ = render_view(gaussians, shot.camera, degree, self.background, low_pass(coarse))
            image = self.method.compare(shot.develop(render), target)
            difference = (image - floats(target.photo)).square()
            if target.mask is not None:
                difference = difference[target.mask]
            return float(difference.double().mean()) if len(difference) else None

        errors = [found for found in ranks.divide(numbers, error) if found is not None]
        if not errors:
            return math.nan
        return -10 * math.log10(max(float(np.mean(errors)) - self.method.noise**2, 1e-10))
