"""Whether a part of a run pays, tried before it: short runs on small copies, judged by photos held back.

Short runs that differ in nothing but the part tell it, on training photos that they have not seen: test views
are never looked at. Two kinds of parts are tried:

- Growth. Where a photo is not yet shown as it is, growth adds Gaussians, whether or not other photos bear
  them out. Poses that are a little off, light that changes, mirrors and what a codec left ask for them
  without end: then they explain each photo alone, and views between photos are worse with every step.
- What changes the look of a scene: gains, vignetting, responses, where the diagnosis finds them. Light that
  moves, a flash and reflections look like them, and a scene shown without them is then wrong all over.
  Photos held back are measured in the look that was learned of their camera, brightness and tint set aside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from hqgs.training.config import TrainConfig, with_iterations
from hqgs.training.plan import RunPlan, Tried
from hqgs.training.rules import MANY_PHOTOS, no_growth

LOOKS = "exposure", "vignetting", "response"  # that small copies show, in the order in which they are tried
EACH, OFFSETS = 4, (1, 3)  # every so-manieth photo is held back, from these on, one after the other
STEPS, SIDES = 400, (120, 320)  # of each short run; px of the copies, at least and at most
SHARE = 0.15  # of the pixels that the run trains on: those of the trial of growth
PIXELS = 10  # of the photos for each Gaussian, at least, where growth is as it likes
LOOK_STEPS, LOOK_SIDE = 200, 120  # of a look, which is of few numbers and smooth

Values = NDArray[np.float64]


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
    if settings.due.stop <= settings.due.start or len(views) <= EACH or not len(scene.points):
        return False
    return _side(scene, settings.iterations) >= SIDES[0]


def tried_growth(scene: Scene, plan: RunPlan, begin: Begin, on_stage: OnStage = silent) -> Tried | None:
    """What photos held back gain where nothing grows; None: no scatter is known. `plan`: of the run; `begin`
    makes trainers."""
    on_stage(Stage("growth", 0, 0, "short test runs: does densification improve validation photos?"))
    exposed = "exposure" if "exposure" in _kinds(plan.settings) else NONE
    config = _settings(plan.settings, len(scene.train), exposed, STEPS)
    found = list[Values]()
    for part in _parts(scene, _side(scene, plan.settings.iterations)):
        trainer = begin(part, config)
        growth, pixels = trainer.plan.settings.densify, _pixels(part)
        most = min(growth.max_gaussians, max(pixels // PIXELS, trainer.plan.first_points))
        grown, still = (
            _values(trainer, densify=replace(growth, **changes))
            for changes in ({"max_gaussians": most}, no_growth(trainer.plan.settings))
        )
        found.append(still - grown)
        if found[-1][:, 0].max(initial=-np.inf) < 0:  # all of the first are worse: others do not turn it
            break
    return _told(np.concatenate(found))


def tried_looks(
    scene: Scene, settings: TrainConfig, begin: Begin, on_stage: OnStage = silent
) -> dict[str, Tried]:
    """What photos held back gain by each of the LOOKS of a formation, beside those before it that pay."""
    asked = [kind for kind in LOOKS if kind in _kinds(settings)]
    if not asked or len(scene.train) <= EACH or not len(scene.points):
        return {}
    on_stage(
        Stage("looks", 0, 0, f"short test runs: does learning {', '.join(asked)} improve validation photos?")
    )
    side = min(LOOK_SIDE, max(max(view.camera.width, view.camera.height) for view in scene.train))
    scene = replace(scene, train=sorted(scene.train, key=lambda view: view.device))  # some of each are held
    run = begin(next(_parts(scene, side)), _settings(settings, len(scene.train), NONE, LOOK_STEPS))
    best, kept, found = _values(run), list[str](), dict[str, Tried]()
    for kind in asked:
        others = _values(run, hqgs=replace(settings.hqgs, formation="+".join([*kept, kind])))
        if (tried := _told((others - best)[:, :1])) is None:
            continue
        found[kind] = tried
        if tried.pays:
            best, kept = others, [*kept, kind]
    return found


def _kinds(settings: TrainConfig) -> set[str]:
    return {step.kind for step in parse_formation(settings.hqgs.formation).steps}


def _side(scene: Scene, iterations: int) -> int:
    """Of the copies' longer sides, px: a trial shows SHARE of the pixels that the run trains on."""
    part = SHARE * iterations / (2 * STEPS * len(OFFSETS))
    longest = max(max(view.camera.width, view.camera.height) for view in scene.train)
    return round(min(longest * np.sqrt(part), SIDES[1]))


def _parts(scene: Scene, side: int) -> Iterator[Scene]:
    """Small copies of a scene, of this longer side, px; each has other photos held back."""
    views = [shrunk(view, side) for view in scene.train]
    for offset in OFFSETS:
        held = range(offset, len(views), EACH)
        train = [view for k, view in enumerate(views) if k not in held]
        yield replace(scene, train=train, test=[views[k] for k in held])


def _pixels(scene: Scene) -> int:
    return sum(view.camera.width * view.camera.height for view in scene.train)


def _values(trainer: ShortRun, **changes: Any) -> Values:
    """PSNR, brightness and tint set aside, SSIM and HaarPSI of each photo held back, [V, 3], after a short
    run with other settings; NaN: its mask leaves nothing, or it is too small."""
    plan = trainer.plan
    trainer.begin(replace(plan, settings=replace(plan.settings, **changes)))
    while trainer.iteration < trainer.length:
        trainer.step()
    values = [
        [measure(view.render, view.photo, view.mask) for measure in (psnr_aligned, ssim, haarpsi)]
        for view in trainer.held_out()
    ]
    return np.array(values, np.float64)


def _told(gains: Values) -> Tried | None:
    """Of the gains of photos [V, K]; PSNR's is the first."""
    gains = gains[np.isfinite(gains[:, 0])]
    gains = gains[:, np.isfinite(gains).all(0)]
    if len(gains) < 2:
        return None
    mean, errors = gains.mean(0), gains.std(0, ddof=1) / np.sqrt(len(gains))
    sure = (mean / np.maximum(errors, np.finfo(float).tiny)).mean()
    return Tried(float(mean[0]), float(errors[0]), len(gains), float(sure))


def _settings(settings: TrainConfig, photos: int, formation: str, steps: int) -> TrainConfig:
    """Of a short run: the run's, but that nothing more is decided; small photos show no shake.

    Opacities of many photos decay over more looks than it has.
    """
    decay = (settings.opacity_decay or 0.0) if photos <= MANY_PHOTOS else 0.0
    short = replace(settings, leave_out=(), seconds=None, turn=None, timed=None)
    return replace(
        with_iterations(short, steps),
        hqgs=replace(settings.hqgs, formation=formation),
        batch=1,
        opacity_decay=decay,
        dropout=settings.dropout or 0.0,
    )
