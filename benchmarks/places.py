"""Where hqgs looks up what the benchmarks time or replace: every name that is patched, in one place."""

from __future__ import annotations

from typing import Any

import torch

from hqgs import _rust
from hqgs.model import render
from hqgs.training import looks, trainer
from hqgs.training.methods import base
from hqgs.training.trainer import Trainer

Place = tuple[Any, str]  # a module or class, and the name that its users look up there

# Replaced by benchmarks/switches.py.
RENDER_VIEW: Place = (looks, "render_view")
RASTERIZATION: Place = (render, "rasterization")
ONE_TORCH_THREAD: Place = (trainer, "one_torch_thread")
ADAM: Place = (trainer, "Adam")
LOSS: Place = (base, "photometric_loss")

# Replaced by benchmarks/accuracy.py, and timed by benchmarks/speed with the stage that they make up.
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
            (RENDER_VIEW, "activations"),  # of the Gaussians, and the checks of hqgs.rasterization
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
