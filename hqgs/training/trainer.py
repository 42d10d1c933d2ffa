"""Training: one step from top to bottom."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.base.left_out import LeftOut
from hqgs.base.ranks import ALONE, Ranks
from hqgs.base.threads import one_torch_thread
from hqgs.base.typed import build
from hqgs.diagnosis.scene import Diagnosis, Inspector
from hqgs.evaluation.held_out import HeldOutViews, history_entry, looks_of_devices
from hqgs.evaluation.records import HistoryEntry
from hqgs.model.gaussians import Gaussians
from hqgs.scene.geometry import photo_pixels
from hqgs.scene.scene import Scene, View
from hqgs.training import checkpoint
from hqgs.training.adam import Adam, reset_opacities
from hqgs.training.batch import gradients_of_several
from hqgs.training.config import TrainConfig, TrainingError, config_values
from hqgs.training.densify import Densifier
from hqgs.training.forward import Gradients, Step, gradients_of_one
from hqgs.training.frame import Trainable
from hqgs.training.guard import MAX_SKIPPED_IN_A_ROW, parameter_fault
from hqgs.training.methods.base import Method
from hqgs.training.overfitting import decay_opacities
from hqgs.training.plan import PlanRow, RunPlan, StepSeconds, Tried, left_out_of
from hqgs.training.prepare import Prepared
from hqgs.training.schedule import (
    CHECKS,
    COARSE_FACTOR,
    FINEST,
    REST,
    Decisions,
    Schedule,
    StepPlan,
    learning_rates,
    on_the_way,
)
from hqgs.training.state import TrainState


class Trainer:
    """A run: its schedule says what a step does, its state what it starts from, its method how a render is
    judged."""

    def __init__(
        self,
        scene: Trainable,
        config: TrainConfig,
        inspector: Inspector | None = None,
        ranks: Ranks = ALONE,
        tries: bool = True,
    ) -> None:
        """`inspector`: what looks at the photos before the first step; `ranks`: the processes that train
        together; `tries`: False where a checkpoint follows, which holds what was tried. ValueError if scene
        or configuration cannot be trained."""
        self.ranks = ranks
        self.prepared: Prepared = Prepared(scene, config, inspector, Trainer if tries else None)
        self.asked: TrainConfig = config
        self.scene: Scene = self.prepared.scene
        self.diagnosis: Diagnosis | None = self.prepared.shown_diagnosis  # None: the method asks for none
        self.lengthened: int | None = None  # the iteration at which a run ended that this one makes longer
        self._stand(self.prepared.plan())

    def begin(self, plan: RunPlan) -> None:
        """Stand before the first step of a run of this plan, with a method that has learned nothing."""
        if self.iteration or plan.settings.hqgs.formation != self.config.hqgs.formation:
            self.prepared.form(plan.settings, Inspector())
        self._stand(plan)

    def branch(self, plan: RunPlan) -> Trainer:
        """A copy of this run as it stands, which goes on by another plan of as many steps."""
        other = copy.deepcopy(self)
        other.plan, other.schedule = plan, Schedule.of(plan, len(self.scene.train))
        return other

    def _stand(self, plan: RunPlan) -> None:
        self.plan: RunPlan = plan
        self.schedule: Schedule = Schedule.of(plan, len(self.scene.train))
        gaussians = self.prepared.first_gaussians(plan)
        self.first_points: int = len(gaussians)
        scene, settings = self.scene, plan.settings
        densifier = Densifier(settings.densify, scene.extent, scene.reach, settings.seed, len(gaussians))
        state = TrainState(gaussians, self._optimizer(gaussians), densifier, self.schedule.start())
        self.state: TrainState = state
        if plan.first_points > len(scene.points):
            why = "the scene's points, and depths on which photos agree"
            state.rows.append(PlanRow("first points found", f"{len(gaussians):,}", why, "", "first_points"))

    @property
    def method(self) -> Method[Any]:
        return self.prepared.method

    @property
    def config(self) -> TrainConfig:
        """The settings that the plan has come to."""
        return self.plan.settings

    @property
    def gaussians(self) -> Gaussians:
        """Those that are trained; `shown` gives those that are rasterized."""
        return self.state.gaussians

    @property
    def iteration(self) -> int:
        """Steps done."""
        return self.state.iteration

    @property
    def seconds(self) -> float:
        """Spent in steps."""
        return self.state.seconds

    @property
    def history(self) -> list[HistoryEntry]:
        """Held-out means."""
        return self.state.history

    @property
    def length(self) -> int:
        """Iterations of the run, as far as it is known: those of the configuration, or fewer."""
        return self.state.decisions.length

    def seconds_left(self) -> float:
        """That the rest of the steps will take, about."""
        cameras = [view.camera for view in self.scene.train]
        pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
        return seconds_left(self.schedule, self.state, pixels)

    def step(self, coarse: bool | None = None) -> Step:
        """Train on the next views (`Schedule.batch`). `coarse`: at the smaller size; None: as planned."""
        started = time.perf_counter()
        state, views, config = self.state, self.prepared.training_views, self.plan.settings
        plans = self.schedule.batch(state.iteration + 1, state.decisions)
        if coarse is not None:
            plans = [replace(plan, coarse=coarse) for plan in plans]
        if plans[0].resets:
            reset_opacities(state.gaussians, state.optimizer, config.densify.reset_opacity)
        last = plans[-1]
        state.iteration = last.iteration
        self._set_rates(last)

        with one_torch_thread():
            if config.batch == 1:
                found = gradients_of_one(last, views, state)
            else:
                found = gradients_of_several(plans, views, state, self.ranks)
            if self._sound([views.views[plan.view] for plan in plans], found):
                found.apply()
                # By rates that fell, a step gives less back: the same decay would make the whole scene fade.
                decay = views.method.rate_left * (config.opacity_decay or 0.0)
                if share := 1 - (1 - decay) ** len(plans):  # 0, too, of a decay that rounding loses
                    decay_opacities(state.gaussians.opacities, share)
            changed = last.densifies and self._densify(last)
            if fault := parameter_fault(state.gaussians, changed):
                state.guard.note(state.iteration, found.step.view, fault)
                self._remove(fault.rows)
            if not len(state.gaussians):
                raise TrainingError(state.none_left())
            for plan, noted in zip(plans, found.measured, strict=True):
                state.iteration = plan.iteration
                views.method.after_step(state, views.target(plan.view, plan.coarse)[0], noted)
            state.recent.append((time.perf_counter() - started) / len(plans))
            if self.schedule.holds(state.decisions):
                state.decisions = by_held_photos(self.schedule, state, self._psnr_of_held)
            if last.averages:
                state.average.add(state.gaussians)

        state.seconds += time.perf_counter() - started
        if self.plan.clock_most or config.turn:
            self._look_at_the_clock()
        return found.step

    def shown(self) -> Gaussians:
        """The Gaussians that are rasterized, without a gradient history; near the end the mean of steps."""
        with one_torch_thread(), torch.no_grad():
            return self.method.modulate(self.state.average.of(self.state.gaussians)).detached()

    def model(self) -> Gaussians:
        """The same in the frame of `given`: what is written."""
        return self.prepared.outward(self.shown())

    def left_out(self) -> list[LeftOut]:
        """What the run did without so far."""
        found, refused = left_out_of(self.plan.rows), self.state.refused
        if refused:
            why = f"smaller than {FINEST:g} pixels of the sharpest photo, so that no photo shows more detail"
            found.append(LeftOut(f"{refused} splits of small Gaussians", why))
        return found + left_out_of(self.state.rows)

    def held_out(self, numbers: Sequence[int] | None = None) -> HeldOutViews:
        """The held-out views of these numbers, for use before the next step; None: all, as reported."""
        if numbers is None:
            views, gaussians = self.prepared.given.test, self.model()
        else:  # in the frame of training: to turn a scene takes longer than to render it
            views, gaussians = [self.scene.test[k] for k in numbers], self.shown()
        degree = self.schedule.degree(self.iteration)
        learned = {photo.name: photo.look for photo in self.method.learned()}
        looks = looks_of_devices(self.scene.train, learned)
        return HeldOutViews(views, gaussians, degree, self.config.background, looks)

    def taken(self, number: int) -> NDArray[np.float32]:
        """The training photo of this number, [H, W, 3], as its own camera takes the scene now."""
        views, degree = self.prepared.training_views, self.schedule.degree(self.iteration)
        with one_torch_thread():
            return views.taken(self.shown(), number, degree).numpy()

    def evaluate(self, views: HeldOutViews | None = None) -> None:
        """Add the held-out means at this iteration to the history, once. Takes no training time.

        `views`: what to measure; None: all at the end of the run, and what `on_the_way` says before it.
        """
        if views is None:
            some = on_the_way(self.scene, self.config.due.eval_every)
            views = self.held_out(None if self.iteration >= self.length else some)
        of = len(self.scene.test)
        if self.history and self.history[-1]["iteration"] == self.iteration:
            if self.history[-1].get("views", of) >= len(views):
                return
            self.history.pop()  # it was of fewer views
        entry = history_entry(views, of, self.iteration, self.seconds, len(self.gaussians), self.ranks)
        self.history.append(entry)

    def save(self, path: str | Path) -> None:
        """Write the whole state as one checkpoint, atomically."""
        of_method = {f"method.{name}": tensor for name, tensor in self.method.state_dict().items()}
        meta = self.state.values() | {
            "recent": list(self.state.recent) if self.plan.clock_most else [],
            "asked": config_values(self.asked),
            "plan": asdict(self.plan),
            "tried": self.prepared.facts.tried and asdict(self.prepared.facts.tried),
            "looks": {name: asdict(tried) for name, tried in self.prepared.facts.looks.items()},
            "scene": checkpoint.scene_fingerprint(self.scene),
        }
        checkpoint.save_checkpoint(path, self.state.tensors() | of_method, meta)

    def restore(self, path: str | Path) -> None:
        """Go on from a checkpoint, bit for bit.

        A run that has come to its end may be trained longer: from there on the schedule is that of the longer
        run, so that learning rates rise again, and the scene may grow again. `lengthened` tells. ValueError
        for a damaged checkpoint, or one of another run; it names the field in which that differs.
        """
        tensors, meta = checkpoint.load_checkpoint(path)
        try:
            checkpoint.check_scene(path, meta["scene"], self.scene)  # first: methods go by the scene
            saved, asked = build(RunPlan, meta["plan"], f"{path}: plan"), config_values(self.asked)
            done, decisions = meta["iteration"], meta["decisions"]
            ended = done == decisions["length"] and self.asked.seconds is None
            more = self.plan.settings.iterations
            lengths = ("iterations", "leave_out", "seconds")
            other = any(meta["asked"].get(name) != asked.get(name) for name in lengths)
            longer = ended and other and more > done
            checkpoint.check_same(path, "", meta["asked"], asked, longer)
            if tried := meta.get("tried"):
                self.prepared.facts = replace(self.prepared.facts, tried=Tried(**tried))
            looks = {name: Tried(**tried) for name, tried in meta.get("looks", {}).items()}
            self.prepared.facts = replace(self.prepared.facts, looks=looks)
            if longer:
                self.begin(self.prepared.plan())
                meta["decisions"] = decisions | {"length": more, "released": decisions["released"] or done}
            else:
                new = {
                    name: getattr(self.config, name)
                    for name in checkpoint.FREE_FIELDS
                    if meta["asked"].get(name) != asked.get(name)
                }
                self.begin(replace(saved, settings=replace(saved.settings, **new)))
            state = self.state.restored(path, tensors, meta, self._optimizer)
            state.recent.extend(meta["recent"])
            if longer:
                self.lengthened = done
                state.rows = [replace(row, left_out=None) for row in state.rows]
                state.average.clear()
                why = "a longer run was asked for after this one had ended"
                state.rows.append(PlanRow("length", f"{more:,} iterations", why, "", "restore", done))
            self.method.load_state_dict(checkpoint.part("method.", tensors))
        except (KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise ValueError(f"the checkpoint {path} is incomplete: {error!r}") from error
        self.state = state

    def _optimizer(self, gaussians: Gaussians) -> Adam:
        """Of these Gaussians, which become leaves, and of the method's tensors."""
        groups: list[dict[str, Any]] = [
            {"name": name, "params": [tensor.requires_grad_()]}  # `_set_rates` has their rates
            for name, tensor in gaussians.named().items()
        ]
        # What the method trains beside the Gaussians has no row for each of them.
        own = [group | {"own": True} for group in self.method.param_groups()]
        return Adam(groups + own, lr=0.0, eps=self.config.adam_eps)

    def _set_rates(self, plan: StepPlan) -> None:
        """As far as the method leaves them; harmonics above the degree in use never had a gradient."""
        groups = {group["name"]: group for group in self.state.optimizer.param_groups}
        densifier = self.state.densifier
        method = self.prepared.method
        rates = learning_rates(self.plan.settings, densifier.extent, plan.part, densifier.reach)
        for name, rate in rates.items():
            groups[name]["lr"] = method.rate_left * rate
        for name, rate in method.rates(plan.part).items():
            groups[name]["lr"] = rate
        groups["shN"]["used"] = (plan.degree + 1) ** 2 - 1

    def _densify(self, plan: StepPlan) -> bool:
        """Add and remove Gaussians; whether there were any."""
        state, finest = self.state, None
        if plan.finest is not None:
            finest = (plan.finest * photo_pixels(state.gaussians.means, self.scene.train)).float()
        densified = state.densifier.update(plan.iteration, state.gaussians, state.optimizer, finest)
        state.refused += densified.refused
        if densified.parents is not None:
            self.method.rows_changed(state, densified.parents)
        return densified.parents is not None

    def _remove(self, bad: Tensor) -> None:
        """Remove the Gaussians that are not finite, bool [N], if there are any."""
        state = self.state
        if count := int(bad.sum()):
            state.average.clear()
            self.method.rows_changed(state, state.densifier.remove(bad, state.gaussians, state.optimizer))
            state.guard.culled += count

    def _look_at_the_clock(self) -> None:
        """Decide after a step, by the clock of the first rank, how long the run is."""
        state, step = self.state, self.state.step_seconds
        decisions = by_the_clock(self.schedule, state.decisions, state.iteration, state.seconds, step)
        if self.plan.clock_most and self.ranks.count > 1:
            decisions = Decisions(**self.ranks.tell(asdict(decisions))[0])
        if decisions != state.decisions:
            why = "as recorded" if self.config.turn else f"what fits into {self.config.seconds:g} s"
            evidence = f"{state.seconds:.1f} s so far, {1e3 * step:.1f} ms a step"
            length = f"{decisions.length:,} iterations"
            state.rows.append(PlanRow("length", length, why, evidence, "clock", state.iteration))
        state.decisions = decisions

    def _psnr_of_held(self) -> float:
        """Of the training photos that are held back, as the method compares them."""
        degree, coarse = self.schedule.degree(self.iteration), self.iteration <= self.plan.half_size_until
        numbers, views = self.schedule.held, self.prepared.training_views
        return views.psnr(self.shown(), numbers, degree, coarse, self.ranks)

    def _sound(self, views: Sequence[View], found: Gradients) -> bool:
        """Whether the step has gradients to go by, of one view at least; the guard notes its faults.

        Gaussians whose gradient is not finite are removed, and then no row is where the others' gradients
        have it: the whole step is skipped.
        """
        state, guard = self.state, self.state.guard
        faults = [(view, fault) for view, fault in zip(views, found.faults, strict=True) if fault is not None]
        for view, fault in faults:
            guard.note(state.iteration, view, fault)
        skipped = len(faults)
        if faults and (bad := torch.stack([fault.rows for _, fault in faults]).any(dim=0)).any():
            self._remove(bad)
            skipped = len(views)
        guard.skipped += skipped
        guard.skipped_in_a_row = guard.skipped_in_a_row + 1 if skipped == len(views) else 0
        if guard.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingError(
                f"training stopped: the loss or a gradient was NaN or Inf in {guard.skipped_in_a_row} steps "
                f"in a row, up to iteration {state.iteration}; the last loss is {found.step.loss}, of view "
                f"{found.step.view.name!r}"
            )
        return skipped < len(views)


def fit_to_seconds(trainer: Trainer) -> None:
    """Plan a run that has so many seconds anew, by the time that its first steps take, and let it begin.

    Does nothing to a run without a number of seconds, or whose length is recorded. The trainer is a fresh
    one; the steps leave nothing behind.
    """
    if trainer.asked.seconds is None or trainer.asked.turn is not None:
        return
    half = _timed(trainer, True) if trainer.plan.half_size_until else 0.0
    half, full = trainer.ranks.tell([half, _timed(trainer, False)])[0]
    trainer.begin(trainer.prepared.plan(StepSeconds(full, half)))


def _timed(trainer: Trainer, half_size: bool) -> float:
    """Mean seconds of a step's view at half or at full size."""
    for _ in range(3):  # the first ones start threads and fill caches
        trainer.step(half_size)
    started, before = trainer.seconds, trainer.iteration
    for _ in range(7):
        trainer.step(half_size)
    return (trainer.seconds - started) / (trainer.iteration - before)


# How long a run is, decided while it trains. A few training photos are held back at first, where it is not
# known how long a run pays: they tell whether it still improves. Then they come back, early enough that the
# scene can still grow where only they look. Test views are never looked at. The rest of a run that has so
# many seconds, after growth, is as long as the clock allows.

# dB and iterations: the run has stopped improving where held-back photos gain no more in so many.
BETTER, PATIENCE = 0.05, 2_000


def by_held_photos(schedule: Schedule, state: TrainState, psnr: Callable[[], float]) -> Decisions:
    """The decisions after a step: whether held-back photos end the run sooner, or come back.

    `psnr`: of those photos now, dB; NaN where their masks leave nothing. Rows of the state tell it.
    """
    decisions, iteration, total = state.decisions, state.iteration, schedule.run.settings.iterations
    small = iteration <= schedule.run.half_size_until
    if iteration % CHECKS == 0 and not small and not math.isnan(now := psnr()):
        if now > state.best + BETTER:
            state.best, state.best_at = now, iteration
        if iteration - state.best_at >= PATIENCE:
            length = min(total, math.ceil((1 + REST) * iteration))
            decisions = replace(decisions, length=length, released=iteration)
            why = "the validation photos stopped improving"
            told = f"best {state.best:.2f} dB at iteration {state.best_at}, {now:.2f} dB at {iteration}"
            left = f"iterations {length + 1} to {total}"
            row = PlanRow("length", f"{length:,} iterations", why, told, "iterations", iteration, left)
            state.rows.append(row)
    if iteration == schedule.run.settings.due.stop:
        decisions = replace(decisions, released=iteration)
    if decisions.released:
        why = "the scene needs them where no other photo looks"
        state.rows.append(
            PlanRow("validation photos", "trained on from here", why, "", "held_photos", iteration)
        )
    return decisions


def by_the_clock(
    schedule: Schedule, decisions: Decisions, iteration: int, seconds: float, step: float
) -> Decisions:
    """The decisions after a step: at `Schedule.turn_at` the rest gets the length that the clock allows.

    `seconds`: that the run has taken; `step`: those of a step now. Settings with a `turn` follow that in
    place of the clock.
    """
    config = schedule.run.settings
    if decisions.turned:
        return decisions
    at, most = schedule.turn_at(decisions), schedule.run.clock_most
    if config.turn is not None:
        length = config.turn[1]
    elif most and config.seconds is not None:
        rest = config.iterations - at
        left = (config.seconds - seconds) / step if step > 0 else rest
        length = at + round(min(max(left, 0.1 * rest), 4.0 * rest))
        length = min(length, most)
    else:
        return decisions
    if iteration != at or not at < min(length, config.iterations) or length == decisions.length == most:
        return decisions
    return replace(decisions, length=length, turned=at)


def seconds_left(schedule: Schedule, state: TrainState, pixels: float) -> float:
    """What the steps to come will take, by the last ones: a step takes time for its pixels and its Gaussians,
    about as much for one as for the other. `pixels`: of a training photo, in the mean.
    """
    done, length, count = state.iteration, state.decisions.length, len(state.gaussians)
    small = pixels / COARSE_FACTOR**2
    coarse = max(min(schedule.run.half_size_until, length) - done, 0)
    stop, growth = schedule.densification_end(state.decisions), schedule.run.settings.densify
    growing = max(stop - done, 0) if schedule.run.settings.due.start < stop else 0
    # Until growth ends a scene gains about twice its Gaussians: 1.4 to 7.5 times in runs of 1,000.
    more = min(2 * (growing / max(stop, 1)) ** 2 * count, max(growth.max_gaussians - count, 0))
    work = coarse * small + (length - done - coarse) * pixels
    work += count * (length - done) + more * (length - done - growing / 2)
    return median(state.recent) * work / ((small if coarse else pixels) + count) if state.recent else 0.0
