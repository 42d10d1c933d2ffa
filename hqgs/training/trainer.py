"""Training: one step from top to bottom."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hqgs.base.left_out import LeftOut
from hqgs.base.machine import peak_rss_mb
from hqgs.base.stages import OnStage, untold
from hqgs.base.threads import one_torch_thread
from hqgs.diagnosis.choice import choose_photos
from hqgs.diagnosis.scene import Diagnosis, Inspector
from hqgs.evaluation.held_out import HeldOutViews, held_out_means
from hqgs.evaluation.metrics import psnr, ssim
from hqgs.evaluation.records import HistoryEntry
from hqgs.model.gaussians import Gaussians
from hqgs.model.rasterization import RasterizationMeta
from hqgs.model.render import render_view
from hqgs.photos.pixels import floats
from hqgs.scene.geometry import photo_pixels
from hqgs.scene.scene import Scene, View
from hqgs.training import checkpoint
from hqgs.training.adam import Adam, cut_harmonics, reset_opacities
from hqgs.training.clock import turned
from hqgs.training.config import TrainConfig
from hqgs.training.densify import Densifier, Growth
from hqgs.training.frugality import Frugality
from hqgs.training.guard import LISTED, Event, Fault, Guard, bad_values, gradient_fault, parameter_fault
from hqgs.training.methods import make_method
from hqgs.training.methods.base import Method, Target
from hqgs.training.schedule import Plan, Schedule, learning_rates, on_the_way, smaller
from hqgs.training.state import TrainState

MAX_SKIPPED_IN_A_ROW = 20  # steps; one bad view may pass, a broken run should not go on for hours


class TrainingError(RuntimeError):
    """The training cannot go on; the message says why and at which iteration."""


@dataclass(frozen=True)
class Step:
    """What a training step has seen."""

    loss: float
    render: Tensor  # [H, W, 3], detached
    view: View


class Trainer:
    """A run: its schedule says what a step does, its state what it starts from, its method how a render is
    judged, and its frugality what may be left out from then on."""

    def __init__(self, scene: Scene, config: TrainConfig, told: OnStage = untold) -> None:
        """`told` hears of the preparation. ValueError if scene or configuration cannot be trained."""
        scene.check_trainable()
        inspector = Inspector(told)  # for all that looks at the photos before the first step
        self.photos_left_out: list[LeftOut] = []
        if "photos" in config.leave_out:
            scene, self.photos_left_out = choose_photos(scene, inspector)
        self.scene = scene
        self.extent: float = scene.extent
        self.method: Method[Any] = make_method(scene, config, inspector)
        self.diagnosis: Diagnosis | None = inspector.last  # None: the method asks for none
        with one_torch_thread():
            self._targets = [self.method.prepare(view) for view in scene.train]
            start = self.method.start(scene, self._targets, config)
        self.lengthened: int | None = None  # the iteration at which a run ended that this one makes longer
        self._small: dict[int, tuple[View, Target]] = {}
        self.config: TrainConfig = start.config
        config = start.config
        self.method_left_out: list[LeftOut] = start.left_out
        self.first_points: int = len(start.gaussians)
        self.schedule: Schedule = Schedule.of(config, scene.train, self.method.as_photographed)
        self.frugality: Frugality = Frugality(self.schedule, scene.train, self.shown, self._psnr)
        self.state: TrainState = TrainState(
            start.gaussians,
            self._optimizer(start.gaussians),
            Densifier(config.densify, self.extent, scene.reach, config.seed, self.first_points),
            self.schedule.start(),
        )

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
    def guard(self) -> Guard:
        return self.state.guard

    @property
    def history(self) -> list[HistoryEntry]:
        """Held-out means."""
        return self.state.history

    @property
    def length(self) -> int:
        """Iterations of the run, as far as it is known: those of the configuration, or fewer."""
        return self.state.decisions.length

    def next_plan(self) -> Plan:
        """What the next step is to do."""
        return self.schedule.plan(self.iteration + 1, self.state.decisions)

    def step(self, plan: Plan | None = None) -> Step:
        """Train on one view; `plan`: None: the next one."""
        started = time.perf_counter()
        state, method = self.state, self.method
        plan = self.next_plan() if plan is None else plan
        if plan.resets:
            reset_opacities(state.gaussians, state.optimizer, self.config.densify.reset_opacity)
        state.iteration = plan.iteration
        view, target = self._seen(plan.view, plan.coarse)
        self._set_rates(plan)

        with one_torch_thread():
            gaussians = method.modulate(state.gaussians)
            shot = method.shot(view, target)
            render, meta = render_view(gaussians, shot.camera, plan.degree, self.config.background)
            meta["means2d"].retain_grad()  # [1, N, 2]
            photo = shot.develop(render)
            image = method.compare(photo, target)
            loss = method.loss(image, target)
            state.optimizer.zero_grad()
            if self._backward(loss, render, view):
                self._update(plan, meta, view)
            growth = self._grow(plan) if plan.grows else Growth()
            self._cull(view, parameter_fault(state.gaussians, growth.parents is not None))
            if not len(state.gaussians):
                raise TrainingError(state.none_left())
            method.after_step(state, view, image, target)
            self._leave_out(growth, time.perf_counter() - started)

        state.seconds += time.perf_counter() - started
        state.decisions = turned(self.config, self.schedule, state, self.frugality.step_seconds)
        return Step(float(loss.detach()), photo.detach(), view)

    def shown(self) -> Gaussians:
        """The Gaussians that are rasterized, without a gradient history."""
        with one_torch_thread(), torch.no_grad():
            return self.method.modulate(self.state.gaussians).detached()

    def left_out(self) -> list[LeftOut]:
        """What the run did without so far."""
        return [*self.photos_left_out, *self.frugality.left_out(), *self.method_left_out]

    def held_out(self, numbers: Sequence[int] | None = None) -> HeldOutViews:
        """The held-out views of these numbers (None: all), for use before the next step."""
        views = self.scene.test if numbers is None else [self.scene.test[k] for k in numbers]
        degree = self.schedule.degree(self.iteration, self.state.decisions)
        return HeldOutViews(views, self.shown(), degree, self.config.background)

    def evaluate(self, views: HeldOutViews | None = None) -> None:
        """Add the held-out means at this iteration to the history, once. Takes no training time.

        `views`: what to measure; None: all at the end of the run, and what `on_the_way` says before it.
        """
        if views is None:
            some = on_the_way(self.scene, self.config.eval_every)
            views = self.held_out(None if self.iteration >= self.length else some)
        of = len(self.scene.test)
        if self.history and self.history[-1]["iteration"] == self.iteration:
            if self.history[-1].get("views", of) >= len(views):
                return
            self.history.pop()  # it was of fewer views
        means = held_out_means([psnr, ssim], views)
        entry: HistoryEntry = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "psnr": means[0],
            "ssim": means[1],
            "gaussians": len(self.gaussians),
            "memory_mb": peak_rss_mb(),
        }
        if len(views) < of:
            entry["views"] = len(views)
        self.history.append(entry)

    def save(self, path: str | Path) -> None:
        """Write the whole state as one checkpoint, atomically."""
        of_method = {f"method.{name}": tensor for name, tensor in self.method.state_dict().items()}
        meta = self.state.values() | {
            "frugality": self.frugality.state_dict(),
            "config": asdict(self.config),
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
        lists = {k: list(v) for k, v in vars(self.config).items() if isinstance(v, tuple)}  # as JSON has them
        try:
            # The scene first: methods fit the configuration to it.
            checkpoint.check_scene(path, meta["scene"], self.scene)
            self.lengthened = checkpoint.lengthened(meta, self.config.iterations)
            longer = self.lengthened is not None
            checkpoint.check_same(path, "", meta["config"], asdict(self.config) | lists, longer)
            state = self.state.restored(path, tensors, meta, self._optimizer)
            self.frugality.load_state_dict(meta["frugality"])
            if longer:
                self.frugality.forget_end()
            self.method.load_state_dict(checkpoint.part("method.", tensors))
        except (KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise ValueError(f"{path} is no whole checkpoint of a run: {error!r}") from error
        self.state = state

    def _optimizer(self, gaussians: Gaussians) -> Adam:
        """Of these Gaussians, which become leaves, and of the method's tensors."""
        groups: list[dict[str, Any]] = [
            {"name": name, "params": [tensor.requires_grad_()]}  # `_set_rates` has their rates
            for name, tensor in gaussians.named().items()
        ]
        # Methods' own tensors have no row for each Gaussian: all of them are updated.
        own = [group | {"every_row": True} for group in self.method.param_groups()]
        return Adam(groups + own, lr=0.0, eps=self.config.adam_eps)

    def _seen(self, number: int, coarse: bool) -> tuple[View, Target]:
        """A training view and its target, at full size or at the smaller one."""
        view = self.scene.train[number]
        if not coarse:
            return view, self._targets[number]
        if number not in self._small:
            small = smaller(view)
            self._small[number] = small, self.method.prepare(small)
        return self._small[number]

    def _set_rates(self, plan: Plan) -> None:
        """As far as the method leaves them. Adam passes harmonics above the degree in use over: they never
        had a gradient."""
        groups = {group["name"]: group for group in self.state.optimizer.param_groups}
        for name, rate in learning_rates(self.config, self.extent, plan.part).items():
            groups[name]["lr"] = self.method.rate_left * rate
        for name, rate in self.method.rates(plan.part).items():
            groups[name]["lr"] = rate
        groups["shN"]["used"] = (plan.degree + 1) ** 2 - 1

    def _update(self, plan: Plan, meta: RasterizationMeta, view: View) -> None:
        """Note the gradients of the 2D means and let Adam take its step."""
        state, radii = self.state, meta["radii"][0]
        if plan.observes:
            gradient = meta["means2d"].grad
            assert gradient is not None  # the backward pass was sound
            state.densifier.observe(gradient[0], radii, view.camera.width, view.camera.height)
        visible = (radii > 0).all(dim=1) if self.config.selective_adam else None
        state.optimizer.step(visible=visible)

    def _grow(self, plan: Plan) -> Growth:
        """Add and remove Gaussians."""
        state, finest = self.state, None
        if plan.finest is not None:
            finest = (plan.finest * photo_pixels(state.gaussians.means, self.scene.train)).float()
        growth = state.densifier.update(plan.iteration, state.gaussians, state.optimizer, finest)
        if growth.parents is not None:
            self.method.rows_changed(state, growth.parents)
        return growth

    def _leave_out(self, growth: Growth, seconds: float) -> None:
        """Do without what the frugality finds to be of no use."""
        state = self.state
        verdict = self.frugality.after_step(state, growth.refused, seconds)
        state.decisions = verdict.decisions
        if verdict.colors is not None:
            cut_harmonics(state.gaussians, state.optimizer, **verdict.colors)
        if verdict.faint is not None:
            self._remove(verdict.faint)

    def _remove(self, rows: Tensor) -> None:
        """Remove the Gaussians of these rows, bool [N]."""
        state = self.state
        self.method.rows_changed(state, state.densifier.remove(rows, state.gaussians, state.optimizer))

    def _psnr(self, gaussians: Gaussians, numbers: Sequence[int]) -> float:
        """Of training photos as the method compares them, of `gaussians` to rasterize; known noise does not
        count."""
        state, errors = self.state, []
        degree = min(gaussians.sh_degree, self.schedule.degree(state.iteration, state.decisions))
        with torch.no_grad():
            for number in numbers:
                view, target = self._seen(number, self.schedule.is_coarse(state.iteration))
                shot = self.method.shot(view, target)
                render, _ = render_view(gaussians, shot.camera, degree, self.config.background)
                image = self.method.compare(shot.develop(render), target)
                difference = (image - floats(target.photo)).square()
                if target.mask is not None:
                    difference = difference[target.mask]
                errors.append(float(difference.double().mean()))
        return -10 * math.log10(max(float(np.mean(errors)) - self.method.noise**2, 1e-10))

    def _backward(self, loss: Tensor, render: Tensor, view: View) -> bool:
        """Compute the gradients. Where the loss or a gradient is not finite: False, and the guard knows.

        Gaussians whose gradient is not finite are removed.
        """
        state, guard = self.state, self.state.guard
        finite = math.isfinite(loss.detach())
        if finite:
            render.retain_grad()
            loss.backward()
            fault = gradient_fault(state.gaussians, state.optimizer, render)
            self._cull(view, fault)
            finite = fault is None
        else:
            count = bad_values(view)
            guard.add(Event(state.iteration, view.name, "photo" if count else "loss", [], count, []))
        guard.skipped += not finite
        guard.skipped_in_a_row = 0 if finite else guard.skipped_in_a_row + 1
        if guard.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingError(
                f"the loss or a gradient was not finite in {guard.skipped_in_a_row} steps in a row, up to "
                f"iteration {state.iteration}; the last loss is {float(loss.detach())}, of view {view.name!r}"
            )
        return finite

    def _cull(self, view: View, fault: Fault | None) -> None:
        """Note what was not finite, and remove the Gaussians at fault."""
        if fault is None:
            return
        state, indices = self.state, torch.nonzero(fault.rows)[:, 0]
        listed = indices[:LISTED].tolist()
        state.guard.add(Event(state.iteration, view.name, fault.what, fault.tensors, len(indices), listed))
        if len(indices):
            self._remove(fault.rows)
            state.guard.culled += len(indices)
