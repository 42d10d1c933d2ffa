"""What the benchmarks time or replace in hqgs: every name that is patched, in one place.

And what is put there: other knobs of the rasterizer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any
from unittest.mock import patch

import torch

from hqgs import _rust
from hqgs._rust import ALPHA_MIN, TRANSMITTANCE_MIN
from hqgs.training import forward
from hqgs.training.trainer import Trainer

Place = tuple[Any, str]  # a module or class, and the name that its users look up there

# Replaced with other knobs, and timed by benchmarks/speed with the stage that they make up.
PROJECT: Place = (_rust, "project_forward")
COMPOSITE: Place = (_rust, "composite_forward")
CRATE: dict[Place, str] = {
    PROJECT: "project",
    COMPOSITE: "bin and composite",
    (_rust, "composite_backward"): "composite backward",
    (_rust, "project_backward"): "project backward",
}


def parts_of_step(trainer: Trainer) -> dict[Place, str]:
    """The functions that a training step calls, in its order, with the part of the step that they make up.

    Each part is without the others that run inside it.
    """
    state, (project, composite, *backward) = trainer.state, CRATE.items()
    return dict(
        [
            ((forward, "render_view"), "activations"),  # and the checks of hqgs.rasterization
            ((type(trainer.method), "modulate"), "method"),  # before they are rasterized
            project,
            composite,
            ((type(trainer.method), "loss"), "loss"),
            ((torch.Tensor, "backward"), "autograd"),  # of the activations, and torch's own work
            *backward,
            ((type(state.densifier), "observe"), "density statistics"),
            ((type(state.densifier), "update"), "density statistics"),
            ((type(state.optimizer), "step"), "Adam"),
        ]
    )


@dataclass(frozen=True)
class Knobs:
    """The settings of `AccuracyKnobs` in rust/accuracy_knobs.rs, and the dtype."""

    dtype: str = "float32"
    alpha_min: float = ALPHA_MIN  # smallest alpha that is blended
    transmittance_min: float = TRANSMITTANCE_MIN  # compositing stops there
    spans: str = "ellipse"  # the tiles of a Gaussian: of its support, or of its "box"
    skip_blocks: bool = True  # leave out the 4 x 4 blocks that a Gaussian does not reach


@contextmanager
def tuned(knobs: Knobs) -> Iterator[None]:
    """Inside it the rasterizer has these knobs, the dtype aside."""
    _, *values = asdict(knobs).values()
    with patch.object(*PROJECT, partial(getattr(*PROJECT), knobs=tuple(values))):
        yield
