"""The guard of a training run: a value that is not finite is caught where it first appears, and named."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs.scene.scene import View

LIMIT = 1e18  # larger numbers count as not finite too: Adam keeps their squares, which overflow 32 bits
LISTED = 10  # Gaussians that an event names, the first ones
KEPT = 20  # events that are kept, the first ones; all are counted


@dataclass(frozen=True)
class Event:
    """Something that was not finite. `gaussians` are row numbers at that iteration."""

    iteration: int
    view: str  # the training view of the step
    what: str  # "photo", "loss", "gradient" or "parameter"
    tensors: list[str]  # where it was found: "render", "means", ...; empty for a photo or the loss
    count: int  # pixels' values of a photo, Gaussians elsewhere; 0 where no Gaussian is at fault
    gaussians: list[int]


@dataclass
class Guard:
    """What was not finite in a run so far. Plain JSON values, so that a checkpoint can hold it."""

    skipped: int = 0  # steps without an update
    skipped_in_a_row: int = 0
    culled: int = 0  # Gaussians that were removed
    num_events: int = 0
    events: list[dict[str, Any]] = field(default_factory=list)  # the first ones, as `Event`

    def add(self, event: Event) -> None:
        self.num_events += 1
        if len(self.events) < KEPT:
            self.events.append(asdict(event))

    def summary(self) -> dict[str, Any]:
        """For report.json."""
        return {
            "skipped_steps": self.skipped,
            "culled_gaussians": self.culled,
            "num_events": self.num_events,
            "events": self.events,
        }


def is_sound(tensor: Tensor) -> bool:
    """Whether no value can be NaN, Inf or beyond LIMIT. One pass; False may be a false alarm.

    The sum of squares has no term that another one could cancel.
    """
    values = tensor.detach().reshape(-1)
    return float(torch.dot(values, values)) < LIMIT**2


def bad_rows(tensors: Mapping[str, Tensor]) -> tuple[list[str], Tensor]:
    """The names of the tensors [N, ...] with a value that is not finite or beyond LIMIT, and which rows
    have one in any tensor, bool [N]."""
    names, rows = [], torch.zeros(len(next(iter(tensors.values()))), dtype=torch.bool)
    for name, tensor in tensors.items():
        bad = ~(tensor.detach().abs() < LIMIT).reshape(len(rows), -1).all(dim=1)
        if bad.any():
            names.append(name)
            rows |= bad
    return names, rows


def bad_values(view: View) -> int:
    """How many values of a view's photos are not finite where the mask counts them."""
    photo = view.image if view.mask is None else view.image[view.mask]
    low = [] if view.low is None else [view.low]
    return sum(int((~np.isfinite(a)).sum()) for a in (photo, *low) if a.dtype != np.uint8)
