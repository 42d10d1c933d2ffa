"""Cleaning of a scene that is there, of this or another program: fog and shards before other photos go.

What hangs in the air between the photos is right in one of them. The scene is fitted on to the photos with
opacities that decay and Gaussians that drop out (overfitting.py): what one photo alone holds up fades;
nothing grows and nothing moves. Photos held out tell whether it pays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from hqgs._rust import ALPHA_MIN
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.held_out import held_out_renders
from hqgs.evaluation.intervals import half_width
from hqgs.evaluation.metrics import psnr
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.scene import Scene
from hqgs.training.adam import Adam
from hqgs.training.config import TrainConfig
from hqgs.training.constants import CLEANING_DECAY, CLEANING_STEPS, DROPOUT
from hqgs.training.guard import coming_gradient, gradient_fault
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.overfitting import decay_opacities, with_dropout


@dataclass(frozen=True)
class Cleaned:
    """A scene after cleaning, and what held-out photos say of it."""

    gaussians: Gaussians
    removed: int
    before: tuple[float, ...]  # PSNR of each held-out photo, dB
    after: tuple[float, ...]

    @property
    def gain(self) -> float:
        """dB, mean over the held-out photos."""
        return float(np.mean(np.subtract(self.after, self.before)))

    @property
    def interval(self) -> float:
        """Half that of the gain, paired by photo, dB; infinite for one photo."""
        half = half_width(np.subtract(self.after, self.before).tolist())
        return math.inf if half is None else half

    @property
    def pays(self) -> bool:
        """Whether the gain exceeds its interval."""
        return self.gain > self.interval


def clean(
    gaussians: Gaussians, scene: Scene, steps: int = CLEANING_STEPS, on_stage: OnStage = silent
) -> Cleaned:
    """The Gaussians fitted on to the scene's training photos for so many steps.

    Same bits for any number of threads. ValueError where the scene has fewer than 2 held-out
    photos, or `steps` is below 1.
    """
    if len(scene.test) < 2:
        held = f"{scene.name} has {len(scene.test)} held-out photos"
        raise ValueError(
            f"{held}, wanted at least 2: the interval of their gains tells whether cleaning pays"
        )
    if steps < 1:
        raise ValueError(f"steps is {steps}, wanted at least 1")
    before = _held_out(gaussians, scene)
    config, method, rng = TrainConfig(), ThreeDGS(), np.random.default_rng(0)
    rates = {
        name: getattr(config, f"lr_{name}") for name in ("scales", "quats", "opacities", "sh0", "shN")
    } | {"means": 0.0}
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in gaussians.named().items()}
    fitted = gaussians.like(leaves)
    fitted.errors = None  # they were of what it showed before
    optimizer = Adam(
        [{"name": name, "params": [tensor], "lr": rates[name]} for name, tensor in leaves.items()],
        eps=config.adam_eps,
    )
    rounds = -(-steps // len(scene.train))
    order = np.concatenate([rng.permutation(len(scene.train)) for _ in range(rounds)])[:steps]
    with one_torch_thread():
        targets = [method.prepare(view) for view in scene.train]
        for k, number in enumerate(order.tolist()):
            some = with_dropout(fitted, DROPOUT, 0, k + 1)
            camera = scene.train[number].camera
            render, _ = render_view(some, camera, fitted.sh_degree, config.background)
            of_render = coming_gradient(render)
            optimizer.zero_grad()
            method.loss(render, targets[number]).backward()
            if gradient_fault(fitted, optimizer, of_render) is None:
                optimizer.step()
            decay_opacities(fitted.opacities, CLEANING_DECAY)
            on_stage(Stage("steps of cleaning", k + 1, steps))
        fitted = fitted.detached()
        shown = fitted.activated_opacities() >= ALPHA_MIN
        fitted = fitted.rows(shown)
    return Cleaned(fitted, int((~shown).sum()), before, _held_out(fitted, scene))


@torch.no_grad()
def _held_out(gaussians: Gaussians, scene: Scene) -> tuple[float, ...]:
    """PSNR of each held-out photo, dB."""
    values = [psnr(view.render, view.photo, view.mask) for view in held_out_renders(scene, gaussians)]
    return tuple(value for value in values if value is not None)
