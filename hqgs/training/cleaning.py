"""Cleaning of a scene that is there, of this or another program: fog and shards before other photos go.

What hangs in the air between the photos is right in one of them. The scene is fitted on to the photos with
opacities that decay and Gaussians that drop out (overfitting.py): what one photo alone holds up fades;
nothing grows and nothing moves. Photos held out tell whether it pays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from hqgs._rust import ALPHA_MIN
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.held_out import held_out_renders
from hqgs.evaluation.intervals import half_width
from hqgs.evaluation.judge import flat_psnr
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.verdict import apart
from hqgs.model.formats.ply import MOST_LOGIT
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.constants import BACKGROUND
from hqgs.scene.scene import Scene
from hqgs.training.adam import Adam
from hqgs.training.config import TrainConfig
from hqgs.training.guard import MAX_SKIPPED_IN_A_ROW, coming_gradient, gradient_fault
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.overfitting import decay_opacities, with_dropout
from hqgs.training.rules import DROPOUT

# 300 steps gain 1.0 dB on the room of 8 photos, 600 gain 1.2; half the decay takes twice the steps.
CLEANING_STEPS = 600


@dataclass(frozen=True)
class Cleaned:
    """A scene after cleaning, and what held-out photos say of it."""

    gaussians: Gaussians
    removed: int
    before: tuple[float | None, ...]  # PSNR of each held-out photo, dB; None: masked whole, or the same bits
    after: tuple[float | None, ...]

    @property
    def pairs(self) -> list[tuple[float, float]]:
        """Before and after, of the held-out photos that have both."""
        both = zip(self.before, self.after, strict=True)
        return [(one, other) for one, other in both if one is not None and other is not None]

    @property
    def gain(self) -> float:
        """dB, mean over the held-out photos; 0 where none has a PSNR."""
        return float(np.mean([after - before for before, after in self.pairs] or [0.0]))

    @property
    def interval(self) -> float:
        """Half that of the gain, paired by photo, dB; infinite for one photo."""
        half = half_width([after - before for before, after in self.pairs])
        return math.inf if half is None else half

    @property
    def pays(self) -> bool:
        """Whether the gain exceeds its interval."""
        return self.gain > self.interval


def clean(
    gaussians: Gaussians,
    scene: Scene,
    steps: int = CLEANING_STEPS,
    background: tuple[float, float, float] = BACKGROUND,
    on_stage: OnStage = silent,
) -> Cleaned:
    """The Gaussians fitted on to the scene's training photos for so many steps.

    Same bits for any number of threads.

    Args:
        gaussians: in `scene.world`.
        background: behind everything, R, G, B.

    Raises:
        ValueError: fewer than 2 held-out photos that a mask leaves something of; `steps` below 1; the
            Gaussians do not show the training photos at all; or no step has a gradient.
    """
    check_steps(steps)
    counted = sum(view.mask is None or bool(view.mask.any()) for view in scene.test)
    if counted < 2:
        raise ValueError(
            f"{scene.name} has {counted} held-out photos, wanted at least 2 (--photos SCENE --test-every N "
            "holds out every N-th): their gains, with an interval, decide whether cleaning helps"
        )
    check_frame(gaussians, scene, background)
    before = held_out_psnrs(gaussians, scene, background)
    config, method, rng = TrainConfig(), ThreeDGS(), np.random.default_rng(0)
    rates = {
        name: getattr(config, f"lr_{name}") for name in ("scales", "quats", "opacities", "sh0", "shN")
    } | {"means": 0.0}
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in gaussians.named().items()}
    with torch.no_grad():  # beyond, the sigmoid is 0 and has no logarithm: other programs write -400
        leaves["opacities"].clamp_(-MOST_LOGIT, MOST_LOGIT)
    fitted = gaussians.like(leaves)
    fitted.errors = None  # they were of what it showed before
    optimizer = Adam(
        [{"name": name, "params": [tensor], "lr": rates[name]} for name, tensor in leaves.items()],
        eps=config.adam_eps,
    )
    rounds = -(-steps // len(scene.train))
    order = np.concatenate([rng.permutation(len(scene.train)) for _ in range(rounds)])[:steps]
    skipped = 0  # in a row
    with one_torch_thread():
        targets = [method.prepare(view) for view in scene.train]
        for k, number in enumerate(order.tolist()):
            some = with_dropout(fitted, DROPOUT, 0, k + 1)
            camera = scene.train[number].camera
            render, _ = render_view(some, camera, fitted.sh_degree, background)
            of_render = coming_gradient(render)
            optimizer.zero_grad()
            method.loss(render, targets[number]).backward()
            fault = gradient_fault(fitted, optimizer, of_render)
            skipped = 0 if fault is None else skipped + 1
            if fault is None:
                optimizer.step()
                decay_opacities(fitted.opacities, 0.01)
            elif skipped == MAX_SKIPPED_IN_A_ROW:
                raise ValueError(
                    f"the {fault.what} of {', '.join(fault.tensors)} was not finite in {skipped} steps in a "
                    f"row, the last with photo {scene.train[number].name!r}"
                )
            on_stage(Stage("steps of cleaning", k + 1, steps))
        fitted = fitted.detached()
        shown = fitted.activated_opacities() >= ALPHA_MIN
        fitted = fitted.rows(shown)
    return Cleaned(fitted, int((~shown).sum()), before, held_out_psnrs(fitted, scene, background))


def check_steps(steps: int) -> None:
    """ValueError where there are none."""
    if steps < 1:
        raise ValueError(f"steps is {steps}, wanted at least 1")


def check_frame(gaussians: Gaussians, scene: Scene, background: tuple[float, float, float]) -> None:
    """ValueError where the renders of most training photos are worse than one flat colour.

    Fitting would give a scene in another frame the photos' colours, and call that a gain.
    """
    some = scene.train[:: -(-len(scene.train) // 16)]
    psnrs = held_out_psnrs(gaussians, replace(scene, test=some), background)
    worse = sum(psnr is not None and psnr < flat_psnr(view) for psnr, view in zip(psnrs, some, strict=True))
    if words := apart(worse, len(some)):
        raise ValueError(f"{scene.name}: {words}")


def held_out_psnrs(
    gaussians: Gaussians, scene: Scene, background: tuple[float, float, float] = BACKGROUND
) -> tuple[float | None, ...]:
    """PSNR of each held-out photo, dB; None where it has none."""
    renders = held_out_renders(scene, gaussians, background=background)
    return tuple(psnr(view.render, view.photo, view.mask) for view in renders)
