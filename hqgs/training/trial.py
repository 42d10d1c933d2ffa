"""Whether a part of a run pays, tried before it: short runs on small copies, judged by photos held back.

Short runs that differ in nothing but the part tell it, on training photos that they have not seen: test views
are never looked at. Two kinds of parts are tried:

- Growth. Where a photo is not yet shown as it is, growth adds Gaussians, whether or not other photos bear
  them out. Poses that are a little off, light that changes, mirrors and what a codec left ask for them
  without end: then they explain each photo alone, and views between photos are worse with every step.
- What photos and cameras have of their own, where the diagnosis finds it: gains, responses, shake. Light that
  moves, a flash and reflections look like the first, and a scene shown without them is then wrong all over.
  Of a photo held back one half is shown, which tells what its camera did; it is measured on the other, as
  that camera takes the scene, brightness and tint set aside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.evaluation.held_out import HeldOutViews
from hqgs.evaluation.metrics import haarpsi, psnr_aligned, ssim
from hqgs.photos.formula import LEARNED, NONE, parse_formation
from hqgs.scene.geometry import shrunk
from hqgs.scene.scene import Scene, View
from hqgs.training.config import TrainConfig, with_iterations
from hqgs.training.plan import RunPlan, Tried
from hqgs.training.rules import MANY_PHOTOS, no_growth


class Looks(NamedTuple):
    """Parts of the formation, in the order in which they are tried, and how."""

    kinds: tuple[str, ...]
    photos: int  # at most
    side: int  # px of the copies
    steps: int  # of each short run
    each: int  # photo is half held back


# A photo's own shake is learned after 20 looks at it, and seen where it has a pixel: in copies of 120 px that
# of the built-in room gains nothing, in 240 px 0.8 dB. Photos gain so differently that it takes many to tell.
# Focus takes more looks than a short run has, and vignetting, which a scene takes over, gains less than short
# runs differ by: there the diagnosis decides.
LOOKS = (Looks(("exposure", "response"), 1000, 120, 200, 4), Looks(("shake",), 16, 240, 320, 2))
EACH, OFFSETS = 4, (1, 3)  # every so-manieth photo is held back, from these on, one after the other
STEPS, SIDES = 400, (80, 320)  # of each short run; px of the copies, at least and at most
SHARE = 0.05  # of the pixels that the run trains on: those of the trial of growth
CLEAR = 2  # standard errors, of the first photos held back, from which others are not asked
PIXELS = 10  # of the photos for each Gaussian, at least, where growth is as it likes

Values = NDArray[np.float64]


class ShortRun(Protocol):
    """What is asked of a trainer here."""

    plan: RunPlan

    @property
    def iteration(self) -> int: ...
    @property
    def length(self) -> int: ...
    def begin(self, plan: RunPlan) -> None: ...
    def branch(self, plan: RunPlan) -> ShortRun: ...
    def step(self) -> Any: ...
    def held_out(self) -> HeldOutViews: ...
    def taken(self, number: int) -> NDArray[np.float32]: ...


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
    exposed = "exposure" if "exposure" in _kinds(plan.settings) else NONE
    config, found = _settings(plan.settings, len(scene.train), exposed, STEPS), list[Values]()
    told, tried = _Told(on_stage, "densification", 2 * STEPS * len(OFFSETS)), None
    for part in _parts(scene, _side(scene, plan.settings.iterations)):
        run = begin(part, config)
        growth, pixels = run.plan.settings.densify, _pixels(part)
        most = min(growth.max_gaussians, max(pixels // PIXELS, run.plan.first_points))
        grows, stays = (
            replace(run.plan, settings=replace(run.plan.settings, densify=replace(growth, **changes)))
            for changes in ({"max_gaussians": most}, no_growth(run.plan.settings))
        )
        run.begin(grows)
        told.steps(run, min(grows.settings.due.start, run.length))
        grown, still = (_values(told.steps(branch)) for branch in (run, run.branch(stays)))
        found.append(still - grown)
        tried = _of_gains(np.concatenate(found))
        if tried is not None and abs(tried.sure) > CLEAR:
            break
    return tried


def tried_looks(
    scene: Scene, settings: TrainConfig, begin: Begin, on_stage: OnStage = silent
) -> dict[str, Tried]:
    """What photos held back gain by each of the LOOKS of a formation, beside those before it that pay and
    vignetting."""
    found, kinds = dict[str, Tried](), _kinds(settings)
    kept = ["vignetting"] if "vignetting" in kinds else []
    for group in LOOKS:
        asked = [kind for kind in group.kinds if kind in kinds]
        if not asked or len(scene.train) <= EACH or not len(scene.points):
            continue
        views = [shrunk(scene.train[k], group.side) for k in evenly(len(scene.train), group.photos)]
        views.sort(key=lambda view: view.device)  # some of each camera's are held back
        held = {k: views[k] for k in range(OFFSETS[0], len(views), group.each)}
        halves = [_half_shown(view) if k in held else view for k, view in enumerate(views)]
        config = _settings(settings, len(views), NONE, group.steps)
        run = begin(replace(scene, train=halves, test=[]), config)
        told = _Told(on_stage, f"learning {', '.join(asked)}", group.steps * (1 + len(asked)))
        best = _with_looks(run, kept, held, told)
        for kind in asked:
            others = _with_looks(run, [*kept, kind], held, told)
            if (tried := _of_gains(others - best)) is not None:
                found[kind] = tried
                best, kept = (others, [*kept, kind]) if tried.pays else (best, kept)
    return found


def _with_looks(run: ShortRun, kinds: Sequence[str], held: Mapping[int, View], told: _Told) -> Values:
    """PSNR of the hidden halves, [V, 1], of a run that learns these kinds, as their own cameras took them."""
    learned = [kind for kind in LEARNED if kind in kinds]
    hqgs = replace(run.plan.settings.hqgs, formation="+".join(learned) or NONE)
    run.begin(replace(run.plan, settings=replace(run.plan.settings, hqgs=hqgs)))
    told.steps(run)
    found = list[list[float | None]]()
    for k, view in held.items():
        half = np.s_[:, view.camera.width // 2 :]
        mask = None if view.mask is None else view.mask[half]
        found.append([psnr_aligned(run.taken(k)[half], view.image[half], mask)])
    return np.array(found, np.float64)


class _Told:
    """Steps of short runs, told while they are done."""

    def __init__(self, on_stage: OnStage, what: str, total: int) -> None:
        self._on_stage, self._what, self._done, self._total = on_stage, f"test runs: {what}", 0, total
        on_stage(Stage(self._what, 0, 0, f"short test runs: does {what} improve validation photos?"))

    def steps(self, run: ShortRun, end: int | None = None) -> ShortRun:
        """Train up to this iteration; None: to the end."""
        while run.iteration < (run.length if end is None else end):
            run.step()
            self._done += 1
            self._on_stage(Stage(self._what, self._done, self._total))
        return run


def _half_shown(view: View) -> View:
    """A view of which the left half counts: enough to tell what its camera did."""
    mask = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask.copy()
    mask[:, view.camera.width // 2 :] = False
    return replace(view, mask=mask)


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


def _values(run: ShortRun) -> Values:
    """PSNR, brightness and tint set aside, SSIM and HaarPSI of each photo held back, [V, 3]; NaN: its mask
    leaves nothing, or it is too small."""
    measures = psnr_aligned, ssim, haarpsi
    values = [[measure(v.render, v.photo, v.mask) for measure in measures] for v in run.held_out()]
    return np.array(values, np.float64)


def _of_gains(gains: Values) -> Tried | None:
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
