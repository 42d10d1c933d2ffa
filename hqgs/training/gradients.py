"""What the views of a step give to it: one by itself, or several, of which each process renders its share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from hqgs.base.ranks import Ranks
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import View
from hqgs.training.batch import Part, Rest, descend, exchanged, note_views, part_of, to_rasterize
from hqgs.training.few_photos import with_dropout
from hqgs.training.guard import Fault
from hqgs.training.looks import Look, Looks
from hqgs.training.schedule import Plan
from hqgs.training.state import TrainState


class Gradients(Protocol):
    """Of one step."""

    @property
    def loss(self) -> float:
        """Of a view that this process has rendered."""
        ...

    @property
    def photo(self) -> Tensor:
        """The developed render of that view, [H, W, 3], detached; of size 0 where there is none."""
        ...

    @property
    def view(self) -> View:
        """That view, of the size at which it was rendered; without one the step's first view."""
        ...

    @property
    def faults(self) -> list[Fault | None]:
        """What was not finite, of each view."""
        ...

    @property
    def measured(self) -> list[Tensor]:
        """What the method goes by after the step, of each view."""
        ...

    def apply(self, state: TrainState) -> None:
        """Move the Gaussians, and note what growth goes by."""
        ...


def gradients_of(
    plans: Sequence[Plan], looks: Looks, state: TrainState, ranks: Ranks, alone: bool
) -> Gradients:
    """The gradients of the views that these plans take; `alone`: each step of the run takes one.

    A single view's gradients stay where they came to be. Those of several are added up as rows, so that the
    bits do not depend on which process rendered what.
    """
    return _OfOne(plans[0], looks, state) if alone else _OfSeveral(plans, looks, state, ranks)


class _OfOne:
    def __init__(self, plan: Plan, looks: Looks, state: TrainState) -> None:
        self._look: Look = looks.at(plan, _of_step(looks.method.modulate(state.gaussians), plan, state))
        state.optimizer.zero_grad()
        self.faults: list[Fault | None] = [self._look.backward(state.gaussians, state.optimizer)]
        self.loss: float = float(self._look.loss.detach())
        self.photo: Tensor = self._look.photo.detach()
        self.view: View = self._look.view
        self.measured: list[Tensor] = [self._look.measured]

    def apply(self, state: TrainState) -> None:
        look = self._look
        radii, gradient = look.meta["radii"][0], look.meta["means2d"].grad
        if look.plan.observes:
            assert gradient is not None  # the backward pass was sound
            camera = look.view.camera
            state.densifier.observe(gradient[0], radii, camera.width, camera.height)
        state.optimizer.step()


@dataclass(frozen=True)
class _Rendered:
    """A view that this process has rendered."""

    loss: float
    photo: Tensor
    view: View


class _OfSeveral:
    def __init__(self, plans: Sequence[Plan], looks: Looks, state: TrainState, ranks: Ranks) -> None:
        self._plans, self._method = plans, looks.method
        rendered: list[_Rendered] = []

        def make(k: int) -> tuple[Part, Callable[[], Rest]]:
            modulated = looks.method.modulate(state.gaussians)
            look = looks.at(plans[k], _of_step(to_rasterize(state.gaussians, modulated), plans[k], state))
            state.optimizer.zero_grad()
            fault = look.backward(state.gaussians, state.optimizer)
            if not rendered:
                rendered.append(_Rendered(float(look.loss.detach()), look.photo.detach(), look.view))
            return part_of(look, fault, state.gaussians, state.optimizer)

        self._parts, self._others = exchanged(ranks, len(plans), make)
        none = _Rendered(self._parts[0].loss, torch.zeros(0, 0, 3), looks.views[plans[0].view])
        first = rendered[0] if rendered else none
        self.loss, self.photo, self.view = first.loss, first.photo, first.view
        self.faults: list[Fault | None] = [part.fault for part in self._parts]
        self.measured: list[Tensor] = [part.measured for part in self._parts]

    def apply(self, state: TrainState) -> None:
        with torch.no_grad():
            modulated = self._method.modulate(state.gaussians)
        rests = descend(self._parts, self._others, state.gaussians, modulated, state.optimizer)
        note_views(self._parts, rests, [plan.observes for plan in self._plans], state.densifier)


def _of_step(gaussians: Gaussians, plan: Plan, state: TrainState) -> Gaussians:
    """Those of `gaussians` that a view is rendered of."""
    return with_dropout(gaussians, plan.dropout, state.densifier.seed, plan.iteration)
