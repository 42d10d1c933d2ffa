"""What the views of a step give to it: one by itself, or several, of which each process renders its share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hqgs.base.ranks import Ranks
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import View
from hqgs.training.batch import Part, Rest, descend, exchanged, note_views, part_of, to_rasterize
from hqgs.training.forward import ForwardPass, TrainingViews
from hqgs.training.guard import Fault
from hqgs.training.overfitting import with_dropout
from hqgs.training.schedule import StepPlan
from hqgs.training.state import TrainState


@dataclass(frozen=True)
class Step:
    """What a training step has seen."""

    loss: float
    render: Tensor  # [H, W, 3], detached
    view: View


class Gradients:
    """Of one step."""

    loss: float  # of a view that this process has rendered
    photo: Tensor  # the developed render of that view, [H, W, 3], detached; of size 0 where there is none
    view: View  # that view, of the size at which it was rendered; without one the step's first view
    faults: list[Fault | None]  # what was not finite, of each view
    measured: list[Tensor]  # what the method goes by after the step, of each view

    def apply(self, state: TrainState) -> None:
        """Move the Gaussians, and note what growth goes by."""
        raise NotImplementedError


def gradients_of(
    plans: Sequence[StepPlan], training: TrainingViews, state: TrainState, ranks: Ranks, alone: bool
) -> Gradients:
    """The gradients of the views that these plans take; `alone`: each step of the run takes one.

    A single view's gradients stay where they came to be. Those of several are added up as rows, so that the
    bits do not depend on which process rendered what.
    """
    return _OfOne(plans[0], training, state) if alone else _OfSeveral(plans, training, state, ranks)


class _OfOne(Gradients):
    def __init__(self, plan: StepPlan, training: TrainingViews, state: TrainState) -> None:
        self._forward: ForwardPass = training.at(
            plan, _of_step(training.method.modulate(state.gaussians), plan, state)
        )
        state.optimizer.zero_grad()
        self.faults = [self._forward.backward(state.gaussians, state.optimizer)]
        self.loss = float(self._forward.loss.detach())
        self.photo = self._forward.photo.detach()
        self.view = self._forward.view
        self.measured = [self._forward.measured]

    def apply(self, state: TrainState) -> None:
        forward = self._forward
        if forward.plan.observes:
            (gradient,), radii = forward.pulls[0], forward.meta["radii"][0]
            camera = forward.view.camera
            state.densifier.observe(gradient, radii, camera.width, camera.height)
        state.optimizer.step()


class _OfSeveral(Gradients):
    def __init__(
        self, plans: Sequence[StepPlan], training: TrainingViews, state: TrainState, ranks: Ranks
    ) -> None:
        self._plans, self._method = plans, training.method
        rendered: list[tuple[float, Tensor, View]] = []

        def make(k: int) -> tuple[Part, Callable[[], Rest]]:
            modulated = training.method.modulate(state.gaussians)
            forward = training.at(
                plans[k], _of_step(to_rasterize(state.gaussians, modulated), plans[k], state)
            )
            state.optimizer.zero_grad()
            fault = forward.backward(state.gaussians, state.optimizer)
            if not rendered:
                rendered.append((float(forward.loss.detach()), forward.photo.detach(), forward.view))
            return part_of(forward, fault, state.gaussians, state.optimizer)

        self._parts, self._others = exchanged(ranks, len(plans), make)
        none = self._parts[0].loss, torch.zeros(0, 0, 3), training.views[plans[0].view]
        self.loss, self.photo, self.view = rendered[0] if rendered else none
        self.faults = [part.fault for part in self._parts]
        self.measured = [part.measured for part in self._parts]

    def apply(self, state: TrainState) -> None:
        with torch.no_grad():
            modulated = self._method.modulate(state.gaussians)
        rests = descend(self._parts, self._others, state.gaussians, modulated, state.optimizer)
        note_views(self._parts, rests, [plan.observes for plan in self._plans], state.densifier)


def _of_step(gaussians: Gaussians, plan: StepPlan, state: TrainState) -> Gaussians:
    """Those of `gaussians` that a view is rendered of."""
    return with_dropout(gaussians, plan.dropout, state.densifier.seed, plan.iteration)
