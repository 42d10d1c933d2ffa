"""The guard of a training run: a value that is not finite is caught where it first appears, and named."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer

from hqgs.evaluation.records import GuardEvent, GuardRecord
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import View

# Larger numbers count as not finite too: Adam keeps their squares, which overflow 32 bits.
GUARD_LIMIT = 1e18
LOG_LIMIT = math.log(2.0**128)  # of the scales' logarithms: exp of more overflows 32 bits
EVENTS_KEPT, GAUSSIANS_LISTED = 20, 10  # the first events, and the first Gaussians that an event names
MAX_SKIPPED_IN_A_ROW = 20  # steps; one bad view may pass, a broken run should not go on for hours


@dataclass
class Guard:
    """What was not finite in a run so far. Plain JSON values, so that a checkpoint can hold it."""

    skipped: int = 0  # steps without an update
    skipped_in_a_row: int = 0
    culled: int = 0  # Gaussians that were removed
    num_events: int = 0
    events: list[GuardEvent] = field(default_factory=list)  # the first ones

    def note(self, iteration: int, view: View, fault: Fault) -> None:
        """Add what one look has found."""
        self.num_events += 1
        if len(self.events) == EVENTS_KEPT:
            return
        indices = torch.nonzero(fault.rows)[:, 0]
        event: GuardEvent = {
            "iteration": iteration,
            "view": view.name,
            "what": fault.what,
            "tensors": fault.tensors,
            "count": fault.values + len(indices),
            "gaussians": indices[:GAUSSIANS_LISTED].tolist(),
        }
        self.events.append(event)

    def summary(self) -> GuardRecord:
        """For report.json."""
        return {
            "skipped_steps": self.skipped,
            "culled_gaussians": self.culled,
            "num_events": self.num_events,
            "events": self.events,
        }


@dataclass(frozen=True)
class Fault:
    """What was not finite in one look."""

    what: str  # as that of a `GuardEvent`
    tensors: list[str]
    rows: Tensor  # bool [N], the Gaussians at fault
    values: int = 0  # of a photo


def coming_gradient(tensor: Tensor) -> list[Tensor]:
    """Where the gradient of a tensor will be once it is there; `retain_grad` would copy it."""
    found = list[Tensor]()
    tensor.register_hook(found.append)
    return found


def gradient_fault(gaussians: Gaussians, optimizer: Optimizer, of_render: Sequence[Tensor]) -> Fault | None:
    """Where a gradient is not finite.

    The Gaussians are not at fault where the gradient of the loss with respect to the render is not finite
    already: that comes from the view.
    """
    # shN, three quarters of the numbers, is left out: its gradient is sh0's times a bounded basis.
    # A method may leave a tensor without a gradient.
    named = {n: t.grad for n, t in gaussians.named().items() if n != "shN" and t.grad is not None}
    others = [
        (group["name"], param.grad)
        for group in optimizer.param_groups
        if group.get("own")
        for param in group["params"]
        if param.grad is not None
    ]
    if are_sound([*named.items(), *others]):
        return None
    if not all(torch.isfinite(gradient).all() for gradient in of_render):
        return Fault("gradient", ["render"], torch.zeros(len(gaussians), dtype=torch.bool))
    names, rows = bad_rows(gaussians.named())
    if names:  # which is why: the activations pass NaN on
        return Fault("parameter", names, rows)
    names, rows = bad_rows(named)
    names += [name for name, grad in others if not torch.isfinite(grad).all()]
    return Fault("gradient", names, rows) if names else None


def parameter_fault(gaussians: Gaussians, rows_changed: bool) -> Fault | None:
    """Where a Gaussian is not finite. shN is looked at after a change of rows: its gradients are finite, so
    nothing else can spoil it."""
    named = {n: t for n, t in gaussians.named().items() if n != "shN" or rows_changed}
    if are_sound(named.items(), scales=LOG_LIMIT):
        return None
    names, rows = bad_rows(gaussians.named(), scales=LOG_LIMIT)
    return Fault("parameter", names, rows) if names else None


def are_sound(tensors: Iterable[tuple[str, Tensor]], **limits: float) -> bool:
    """Whether no value is NaN, Inf or beyond GUARD_LIMIT (or one of `limits`); float32 or float64."""
    for name, tensor in tensors:
        if tensor.numel():
            limit = limits.get(name, GUARD_LIMIT)
            low, high = torch.aminmax(tensor.detach())  # NaN, both, if there is one
            if not (-limit < low.item() and high.item() < limit):
                return False
    return True


def bad_rows(tensors: Mapping[str, Tensor], **limits: float) -> tuple[list[str], Tensor]:
    """The names of the tensors [N, ...] with a value that is not finite or beyond GUARD_LIMIT (or one of
    `limits`), and which rows have one in any tensor, bool [N]."""
    names, rows = [], torch.zeros(len(next(iter(tensors.values()))), dtype=torch.bool)
    for name, tensor in tensors.items():
        bad = ~(tensor.detach().abs() < limits.get(name, GUARD_LIMIT)).reshape(len(rows), -1).all(dim=1)
        if bad.any():
            names.append(name)
            rows |= bad
    return names, rows


def bad_values(view: View) -> int:
    """How many values of a view's photos are not finite where the mask counts them."""
    photo = view.image if view.mask is None else view.image[view.mask]
    low = [] if view.low is None else [view.low]
    return sum(int((~np.isfinite(a)).sum()) for a in (photo, *low) if a.dtype != np.uint8)
