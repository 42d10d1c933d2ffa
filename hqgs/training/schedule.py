"""What a step does: a pure function of the run's plan, of the decisions so far, and of the iteration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hqgs._rust import EPS2D
from hqgs.base.evenly import middles
from hqgs.scene.geometry import resized
from hqgs.scene.scene import Scene, View
from hqgs.training.config import TrainConfig
from hqgs.training.plan import RunPlan

COARSE_FACTOR = 2  # of the photos' sides, where a run starts small
FINEST = 1.7  # px of the photo that sees a Gaussian best: one with a larger standard deviation may still grow
CHECKS = 500  # iterations between looks at whether the run still improves
REST = 0.5  # of what came before: the length of what follows; in the first half of it the scene still grows


@lru_cache(maxsize=2)
def _order(seed: int, epoch: int, count: int) -> list[int]:
    """The order of so many views in an epoch."""
    return np.random.default_rng([seed, epoch]).permutation(count).tolist()


@dataclass(frozen=True)
class Decisions:
    """What a run has decided so far, as far as its steps depend on it."""

    length: int  # iterations of the run as far as it is known: those of the configuration, or fewer
    released: int  # the iteration after which the held-back photos came back; 0: not yet
    turned: int  # the iteration after which the clock gave the run another length; 0: it did not


@dataclass(frozen=True)
class StepPlan:
    """What one step does, in its order."""

    iteration: int  # 1, 2, ...
    resets: bool  # the opacities are cut before it
    view: int  # number of the training view
    coarse: bool  # photo and camera at 1 / COARSE_FACTOR of the sides
    part: float  # of the run that is done with it, 0..1: what the learning rates follow
    degree: int  # of the harmonics that are trained
    dropout: float  # share of the Gaussians that are left out of it
    observes: bool  # its gradients count for growth
    densifies: bool  # Gaussians are added and removed after it
    finest: float | None  # px of the photo that sees a Gaussian best: finer ones do not grow; None: any may
    averages: bool  # the scene after it counts in the mean that is shown at the end


@dataclass(frozen=True)
class Schedule:
    """The plan of every step of a run."""

    run: RunPlan
    num_views: int  # for training
    held: tuple[int, ...]  # numbers of those that are held back at first

    @classmethod
    def of(cls, run: RunPlan, num_views: int) -> Schedule:
        """Of a run on so many training views."""
        return cls(run, num_views, tuple(middles(num_views, run.held_photos)))

    def start(self) -> Decisions:
        """Before the first step."""
        return Decisions(self.run.settings.iterations, released=0, turned=0)

    def plan(self, iteration: int, decisions: Decisions) -> StepPlan:
        """What step number `iteration` (1, 2, ...) does."""
        config, before = self.run.settings, iteration - 1
        due, stop = config.due, self.densification_end(decisions)
        coarse, part = iteration <= self.run.half_size_until, self.part(iteration, decisions)
        finest = FINEST * (COARSE_FACTOR if coarse else 1) if "growth" in config.leave_out else None
        return StepPlan(
            iteration=iteration,
            # Not after the step that it is due at: what is looked at or written in between is the scene
            # before its opacities are cut, and a run that ends there keeps it.
            resets=0 < before < stop and before % config.densify.reset_every == 0,
            view=self.view(iteration, decisions),
            coarse=coarse,
            part=part,
            degree=self.degree(iteration),
            dropout=(config.dropout or 0.0) * part,
            observes=iteration < stop,
            densifies=due.start < iteration < stop and iteration % due.every == 0,
            finest=finest,
            averages=iteration >= stop and part > 1 - (config.averaged or 0.0),
        )

    def batch(self, iteration: int, decisions: Decisions) -> list[StepPlan]:
        """The plans of the views that one step takes together, from number `iteration` on.

        As many as the configuration says, and fewer where something is due between two of them, or where a
        view would come again. So they follow from the iteration, and growth from the views seen.
        """
        plans = [self.plan(iteration, decisions)]
        while len(plans) < self.run.settings.batch and not self._pauses(plans[-1], decisions):
            following = self.plan(plans[-1].iteration + 1, decisions)
            if following.resets or following.view in {plan.view for plan in plans}:
                break
            plans.append(following)
        return plans

    def _pauses(self, plan: StepPlan, decisions: Decisions) -> bool:
        """Whether something is due, or may be decided, after this plan's view."""
        iteration, densification_end = plan.iteration, self.densification_end(decisions)
        due = {decisions.length, densification_end, self.run.settings.due.stop, self.run.half_size_until}
        due.add(self.turn_at(decisions))
        return (
            plan.densifies
            or iteration in due
            or ("iterations" in self.run.settings.leave_out and iteration % CHECKS == 0)
        )

    def turn_at(self, decisions: Decisions) -> int:
        """The iteration after which the clock may give the run another length: some steps after growth, at
        most a third of the rest, tell what the rest costs."""
        if self.run.settings.turn is not None:
            return self.run.settings.turn[0]
        end = self.densification_end(decisions)
        return end + min(50, max(1, (self.run.settings.iterations - end) // 3))

    def holds(self, decisions: Decisions) -> bool:
        """Whether photos are held back."""
        return bool(self.held) and not decisions.released

    def view(self, iteration: int, decisions: Decisions) -> int:
        """Each epoch visits all views once, in an order of its own."""
        views = list(range(self.num_views))
        if self.holds(decisions):
            views = [k for k in views if k not in self.held]
        epoch, index = divmod(iteration - 1, len(views))
        return views[_order(self.run.settings.seed, epoch, len(views))[index]]

    def part(self, iteration: int, decisions: Decisions) -> float:
        """Of the run that is done with this step, 0..1."""
        total = self.run.settings.iterations
        if decisions.length == total:
            return iteration / total
        changed, length = decisions.turned or decisions.released, decisions.length
        start = changed / total  # what follows is squeezed into the rest, or stretched
        return start + (1 - start) * (iteration - changed) / (length - changed)

    def degree(self, iteration: int) -> int:
        """Of the harmonics that are trained: it rises with the iterations."""
        interval = self.run.settings.due.sh_interval
        if "growth" in self.run.settings.leave_out and self.run.settings.iterations > 3_000:
            interval = min(interval, max(1, self.run.settings.iterations // 20))
        return min(self.run.settings.sh_degree, iteration // interval)

    def densification_end(self, decisions: Decisions) -> int:
        """The iteration from which on nothing grows; a shortened run ends growth sooner."""
        stop = self.run.settings.due.stop
        if decisions.length == self.run.settings.iterations or decisions.turned:
            return stop
        return min(stop, math.ceil((1 + REST / 2) * decisions.released))


def learning_rates(
    config: TrainConfig, extent: float, part: float, reach: float | None = None
) -> dict[str, float]:
    """Of each tensor of the Gaussians. The means' is in units of the extent and falls exponentially.

    Those of 3DGS suit its 30,000 iterations: in a tenth of them a Gaussian cannot become as large, as thin or
    as bright as it should, and stands still before it is where it should be. `faster_rates` lets sizes,
    rotations and colours of n iterations change (30,000 / n)^0.3 times as fast, twice at most, and the means'
    rate end (30,000 / n)^1.5 times as high, at a third of the first at most.

    With `reach`, that of the scene, the means of such a run move (30,000 / n)^0.6 times as fast, at most
    reach / extent times: where cameras stand close together before a distant scene, the extent tells how far
    they are apart, and not how large the scene is that the means move in.
    """
    names = ("scales", "quats", "sh0", "shN")
    faster, farther, last = 1.0, 1.0, config.lr_means_final
    if config.faster_rates:
        shorter = max(1.0, TrainConfig.iterations / config.iterations)
        faster = min(shorter**0.3, 2.0)
        last = max(last, min(last * shorter**1.5, 1 / 3 * config.lr_means))
        if reach is not None:
            farther = max(1.0, min(shorter**0.6, reach / extent))
    means = farther * extent * config.lr_means ** (1 - part) * last**part
    others = {name: faster * getattr(config, f"lr_{name}") for name in names}
    return {"means": means, "opacities": config.lr_opacities, **others}


def on_the_way(scene: Scene, every: int) -> list[int]:
    """Numbers of the held-out views that a run measures every so many steps, before its end: evenly spread.

    As many as have a tenth of the pixels that it trains on between two evaluations, and at least one. It
    follows from sizes alone, so that the same run measures the same views on any machine.
    """
    trained = every * np.mean([view.camera.width * view.camera.height for view in scene.train])
    pixels = np.sort([view.camera.width * view.camera.height for view in scene.test])[::-1]
    count = int((np.cumsum(pixels) <= 0.1 * trained).sum())
    return middles(len(scene.test), max(count, 1))


def smaller(view: View) -> View:
    """The view with photo and camera at 1 / COARSE_FACTOR of the size."""
    camera = view.camera
    return resized(view, round(camera.width / COARSE_FACTOR), round(camera.height / COARSE_FACTOR))


def low_pass(coarse: bool) -> float:
    """The filter of the render that a photo is compared with, px^2 of that photo.

    The filter stays that of the full size, F = COARSE_FACTOR, or else Gaussians would come out thinner than
    the full size wants them. A pixel of the smaller photo is the mean of F x F of the photo's: its variance,
    1/12 of its own px^2, is F^2 times that of one of them, and the difference is added.
    """
    if not coarse:
        return EPS2D
    own = 1 / COARSE_FACTOR**2  # a pixel of the full size, px^2 of the smaller one
    return own * EPS2D + (1 - own) / 12
