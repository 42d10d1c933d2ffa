"""Whether growth pays, tried before a run: short runs on small copies, judged by photos held back from them.

Where a photo is not yet shown as it is, growth adds Gaussians, whether or not other photos bear them out.
Poses that are a little off, light that changes, mirrors and what a codec left ask for them without end: then
they explain each photo alone, and views between photos are worse with every step. Short runs that differ in
nothing but growth tell it, on training photos that they have not seen. Test views are never looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.evaluation.held_out import HeldOutViews
from hqgs.evaluation.metrics import haarpsi, psnr_aligned, ssim
from hqgs.photos.formula import NONE, parse_formation
from hqgs.scene.geometry import shrunk
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.constants import (
    MANY_PHOTOS,
    TRIAL_EACH,
    TRIAL_OFFSETS,
    TRIAL_PIXELS,
    TRIAL_SHARE,
    TRIAL_SIDES,
    TRIAL_STEPS,
)
from hqgs.training.plan import RunPlan, Tried
from hqgs.training.plan_budget import no_growth
from hqgs.training.settings import with_iterations


class ShortRun(Protocol):
    """What is asked of a trainer here."""

    plan: RunPlan

    @property
    def iteration(self) -> int: ...
    @property
    def length(self) -> int: ...
    @property
    def method(self) -> Any: ...
    def begin(self, plan: RunPlan) -> None: ...
    def step(self) -> Any: ...
    def held_out(self) -> HeldOutViews: ...


Begin = Callable[[Scene, TrainConfig], ShortRun]  # a trainer before its first step


def calls_for_trial(scene: Scene, plan: RunPlan) -> bool:
    """Whether growth is to be tried before a run of this plan.

    Not where nothing grows, where no photo can be spared, or where the run is so short that its share of
    pixels leaves too small ones.
    """
    settings, views = plan.settings, scene.train
    if settings.densify.stop <= settings.densify.start or len(views) <= TRIAL_EACH or not len(scene.points):
        return False
    return _side(scene, settings.iterations) >= TRIAL_SIDES[0]


def _side(scene: Scene, iterations: int) -> int:
    """Of the copies' longer sides, px: a trial shows TRIAL_SHARE of the pixels that the run trains on."""
    part = TRIAL_SHARE * iterations / (2 * TRIAL_STEPS * len(TRIAL_OFFSETS))
    longest = max(max(view.camera.width, view.camera.height) for view in scene.train)
    return round(min(longest * np.sqrt(part), TRIAL_SIDES[1]))


def tried_growth(scene: Scene, plan: RunPlan, begin: Begin, on_stage: OnStage = silent) -> Tried | None:
    """What photos held back gain where nothing grows; None: no scatter is known.

    Every TRIAL_EACH-th photo is held back, twice, each time others. `plan`: of the run; `begin` makes
    trainers.
    """
    on_stage(Stage("growth", 0, 0, "trying on photos held back whether growth pays"))
    side = _side(scene, plan.settings.iterations)
    config = _settings(plan.settings, len(scene.train))
    views = [shrunk(view, side) for view in scene.train]
    found = list[NDArray[np.float64]]()
    for offset in TRIAL_OFFSETS:
        held = range(offset, len(views), TRIAL_EACH)
        train = [view for k, view in enumerate(views) if k not in held]
        pixels = sum(view.camera.width * view.camera.height for view in train)
        trainer = begin(replace(scene, train=train, test=[views[k] for k in held]), config)
        found.append(_gains(trainer, pixels))
    gains = np.concatenate(found)
    gains = gains[np.isfinite(gains[:, 0])]  # a mask may leave nothing
    gains = gains[:, np.isfinite(gains).all(0)]  # photos may be too small for HaarPSI
    if len(gains) < 2:
        return None
    mean, errors = gains.mean(0), gains.std(0, ddof=1) / np.sqrt(len(gains))
    sure = (mean / np.maximum(errors, np.finfo(float).tiny)).mean()
    return Tried(float(mean[0]), float(errors[0]), len(gains), float(sure))


def _gains(trainer: ShortRun, pixels: int) -> NDArray[np.float64]:
    """PSNR, brightness and tint set aside, SSIM and HaarPSI of each held-out photo, [V, 3], of a run without
    growth over one with it; `pixels`: of all photos that it trains on."""
    kept = {name: tensor.clone() for name, tensor in trainer.method.state_dict().items()}
    plan, found = trainer.plan, list[NDArray[np.float64]]()
    growth = plan.settings.densify
    most = min(growth.max_gaussians, max(pixels // TRIAL_PIXELS, plan.first_points))
    for changes in ({"max_gaussians": most}, no_growth(growth)):
        trainer.begin(replace(plan, settings=replace(plan.settings, densify=replace(growth, **changes))))
        trainer.method.load_state_dict(kept)
        while trainer.iteration < trainer.length:
            trainer.step()
        values = [
            [measure(view.render, view.photo, view.mask) for measure in (psnr_aligned, ssim, haarpsi)]
            for view in trainer.held_out()
        ]
        found.append(np.array(values, np.float64))  # NaN: a mask leaves nothing
    return found[1] - found[0]


def _settings(settings: TrainConfig, photos: int) -> TrainConfig:
    """Of a short run: the run's, but that nothing more is decided; small photos show no shake.

    Opacities of many photos decay over more looks than it has.
    """
    decay = (settings.opacity_decay or 0.0) if photos <= MANY_PHOTOS else 0.0
    exposed = any(step.kind == "exposure" for step in parse_formation(settings.hqgs.formation).steps)
    return replace(
        with_iterations(replace(settings, leave_out=(), seconds=None, turn=None, timed=None), TRIAL_STEPS),
        hqgs=replace(settings.hqgs, formation="exposure" if exposed else NONE),
        batch=1,
        opacity_decay=decay,
        dropout=settings.dropout or 0.0,
    )
