"""What a run leaves out by itself, decided while it trains, from training photos that are held back.

A few training photos are held back at first. Whether harmonics may go, and whether the run still improves, is
tried on them: what costs no more than TOLERANCE dB goes. Then they come back, early enough that the scene can
still grow where only they look. Test views are never looked at.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hqgs.base.left_out import LeftOut
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.geometry import photo_pixels
from hqgs.scene.scene import View
from hqgs.training.adam import cut_harmonics
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.densify import Growth
from hqgs.training.methods.base import Method
from hqgs.training.schedule import COARSE_FACTOR, COARSE_PART, SMALLEST_SIDE, smaller
from hqgs.training.trials import FOLDED, TOLERANCE, WEIGHTS, fewest_bands, fewest_gaussians, spread

if TYPE_CHECKING:
    from hqgs.training.trainer import Trainer

HELD_SHARE, MOST_HELD, FEWEST_VIEWS = 1 / 20, 4, 10  # of the training views; with fewer none is held back
TRIED = 8  # training photos, at most, on which it is tried to leave Gaussians out
FINEST = 1.7  # px of the photo that sees a Gaussian best: with a larger standard deviation it may still grow
BAND_CHECK = 0.3  # of the run: when the harmonics are tried
EARLIEST = 2_000  # iterations before which they cannot tell yet
BAND_INTERVAL = 1 / 20  # of the run, at most, until the next degree is trained, so that all are there by then
BETTER, PATIENCE, CHECKS = 0.05, 2_000, 500  # dB, iterations, iterations: when a run has stopped improving
REST = 0.5  # of what came before: the length of what follows; in the first half of it the scene still grows
WINDOW = 50  # steps before and after a decision that tell what it saves
RULES = {  # what a result depends on beside the configuration
    "held": (HELD_SHARE, MOST_HELD, FEWEST_VIEWS),
    "tolerance": (TOLERANCE, TRIED, FOLDED),
    "growth": FINEST,
    "resolution": (COARSE_PART, COARSE_FACTOR, SMALLEST_SIDE),
    "weight": WEIGHTS,
    "harmonics": (BAND_CHECK, EARLIEST, BAND_INTERVAL),
    "iterations": (BETTER, PATIENCE, CHECKS, REST),
}


@dataclass
class State:
    """What a checkpoint must hold. `length`: iterations of the run as far as it is known."""

    length: int
    degree: int  # of the harmonics, at most
    released: int = 0  # the iteration after which the held-back photos came back; 0: not yet
    refused: int = 0  # growth of Gaussians that are too fine
    best: float = -1e3  # dB, on the held-back photos
    best_at: int = 0
    decisions: float = 0.0  # seconds that the trials took
    records: list[dict[str, Any]] = field(default_factory=list)  # of `LeftOut`


class Frugality:
    """The decisions of one run. With nothing to leave out it changes no bit of the training."""

    def __init__(self, config: TrainConfig, views: list[View], method: Method) -> None:
        self.config, self.method, self.views = config, method, views
        self.items = set(config.leave_out)
        if not method.as_photographed:  # hqgs grows few Gaussians then: less of them saves no time
            self.items &= {"photos", "iterations"}
        if min(min(v.camera.width, v.camera.height) for v in views) < COARSE_FACTOR * SMALLEST_SIDE:
            self.items -= {"resolution"}
        if self._band_check >= config.densify.stop:  # a run that is too short to tell
            self.items -= {"harmonics"}
        count = 0
        if self.items & {"harmonics", "iterations"} and len(views) >= FEWEST_VIEWS:
            count = min(MOST_HELD, max(1, round(HELD_SHARE * len(views))))
        places = spread(range(len(views)), count)
        self.held = [views[k] for k in places]
        self.trained = [view for k, view in enumerate(views) if k not in places]
        self.state = State(config.iterations, config.sh_degree)
        self._small: dict[str, View] = {}
        self._seconds: deque[float] = deque(maxlen=WINDOW)  # of the last steps
        self._open: list[tuple[int, int, float]] = []  # records that wait for what they saved

    @property
    def holds(self) -> bool:
        """Whether photos are held back now."""
        return bool(self.held) and not self.state.released

    @property
    def length(self) -> int:
        """Iterations of the run, as far as it is known."""
        return self.state.length

    def view(self, iteration: int) -> View:
        """The view of a step. Each epoch visits all views once, in an order of its own."""
        views = self.trained if self.holds else self.views
        epoch, index = divmod(iteration - 1, len(views))
        order = np.random.default_rng([self.config.seed, epoch]).permutation(len(views))
        return self._sized(views[order[index]], iteration)

    def part(self, iteration: int) -> float:
        """How much of the run is done, 0..1: what the learning rate follows."""
        total, state = self.config.iterations, self.state
        if state.length == total:
            return iteration / total
        start = state.released / total  # what follows is squeezed into the shortened rest
        return start + (1 - start) * (iteration - state.released) / (state.length - state.released)

    def degree(self, iteration: int) -> int:
        """Of the harmonics that are trained: it rises with the iterations."""
        interval = self.config.sh_interval
        if "harmonics" in self.items:
            interval = min(interval, max(1, int(BAND_INTERVAL * self.config.iterations)))
        return min(self.state.degree, iteration // interval)

    def finest(self, iteration: int) -> Callable[[Tensor], Tensor] | None:
        """Sizes [N], world units, of Gaussians at means [N, 3] that are fine enough; None: no limit."""
        if "growth" not in self.items:
            return None
        pixels = FINEST * (COARSE_FACTOR if self._is_coarse(iteration) else 1)
        return lambda means: (pixels * photo_pixels(means, self.views)).float()

    def after_step(self, trainer: Trainer, growth: Growth, seconds: float) -> None:
        """Note what the step did, and decide what is due at this iteration."""
        state, iteration = self.state, trainer.iteration
        self._seconds.append(seconds)
        self._close(iteration)
        state.refused += growth.refused
        if not self.items:
            return
        started = time.perf_counter()
        if self.holds:
            self._decide(trainer, iteration)
        if "weight" in self.items and iteration == trainer.densifier.config.stop:
            self._decide_weight(trainer)
        state.decisions += time.perf_counter() - started

    def left_out(self) -> list[LeftOut]:
        """What was left out, in the order of the decisions."""
        found = [LeftOut(**record) for record in self.state.records]
        if self._coarse_end:
            what = f"full resolution in the first {self._coarse_end} iterations"
            found.insert(0, LeftOut(what, f"a scene takes shape at 1/{COARSE_FACTOR} of the sides"))
        if self.state.refused:
            why = f"they had at most {FINEST:g} px of the photo that sees them best (1 standard deviation)"
            found.insert(0, LeftOut(f"finer Gaussians, {self.state.refused} times", why))
        return found

    @property
    def num_higher(self) -> int:
        """Coefficients above degree 0 of each Gaussian."""
        return (self.state.degree + 1) ** 2 - 1

    @property
    def densify_config(self) -> DensifyConfig:
        """The configuration of growth, which a shortened run ends sooner."""
        config = self.config.densify
        if self.state.length == self.config.iterations:
            return config
        return replace(config, stop=min(config.stop, math.ceil((1 + REST / 2) * self.state.released)))

    def state_dict(self) -> dict[str, Any]:
        return asdict(self.state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = State(**state)
        self._open = []

    @property
    def _band_check(self) -> int:
        return max(EARLIEST, round(BAND_CHECK * self.config.iterations), 1)

    @property
    def _coarse_end(self) -> int:
        return round(COARSE_PART * self.config.iterations) if "resolution" in self.items else 0

    def _is_coarse(self, iteration: int) -> bool:
        return iteration <= self._coarse_end

    def _sized(self, view: View, iteration: int) -> View:
        if not self._is_coarse(iteration):
            return view
        if view.name not in self._small:
            self._small[view.name] = smaller(view)
        return self._small[view.name]

    def _decide(self, trainer: Trainer, iteration: int) -> None:
        config, state = self.config, self.state
        if "harmonics" in self.items and iteration == self._band_check:
            self._decide_harmonics(trainer)
        if "iterations" not in self.items:
            if iteration == self._band_check:
                self._release(trainer, iteration)
            return
        if iteration % CHECKS == 0 and not self._is_coarse(iteration):
            now = self._psnr(trainer, self._shown(trainer.gaussians), self.held)
            if now > state.best + BETTER:
                state.best, state.best_at = now, iteration
            if iteration - state.best_at >= PATIENCE:
                state.length = min(config.iterations, math.ceil((1 + REST) * iteration))
                what = f"iterations {state.length + 1} to {config.iterations}"
                evidence = (
                    f"best {state.best:.2f} dB at iteration {state.best_at}, {now:.2f} dB at {iteration}"
                )
                saved = float(np.mean(self._seconds)) * (config.iterations - state.length)
                left = LeftOut(what, "the held-back photos stopped improving", evidence, seconds=saved)
                self._note(left, trainer)
                self._release(trainer, iteration)
        if iteration == config.densify.stop and self.holds:
            self._release(trainer, iteration)

    def _release(self, trainer: Trainer, iteration: int) -> None:
        """The held-back photos come back."""
        self.state.released = iteration
        trainer.densifier.config = self.densify_config

    def _decide_harmonics(self, trainer: Trainer) -> None:
        gaussians = trainer.gaussians
        fewer = fewest_bands(
            gaussians, self._shown(gaussians), self.views, partial(self._psnr, trainer, views=self.held)
        )
        if fewer is None:
            return
        numbers = gaussians.shN.shape[1] - fewer.colors["shN"].shape[1]
        self.state.degree = fewer.degree
        cut_harmonics(gaussians, trainer.optimizer, **fewer.colors)
        left = LeftOut(
            f"harmonics above degree {fewer.degree}",
            f"the {len(self.held)} held-back photos do not ask for them",
            fewer.evidence,
            memory_mb=4 * 12e-6 * numbers * len(gaussians),
            bytes=12 * numbers * len(gaussians),
            cost_db=fewer.cost,
        )
        self._note(left, trainer)

    def _decide_weight(self, trainer: Trainer) -> None:
        gaussians = trainer.gaussians
        tried = spread(self.views, TRIED)
        psnr = partial(self._psnr, trainer, views=tried)
        fewer = fewest_gaussians(self._shown(gaussians), self.views, psnr)
        if fewer is None:
            return
        total, count = len(gaussians), int(fewer.faint.sum())
        row = sum(tensor[:1].numel() for tensor in gaussians.named().values())
        trainer.remove(fewer.faint)
        left = LeftOut(
            f"{count} of {total} Gaussians",
            f"no photo shows them with a blending weight of {fewer.limit:g}",
            f"on {len(tried)} photos {fewer.evidence}",
            memory_mb=4 * 4e-6 * row * count,
            bytes=4 * row * count,
            cost_db=fewer.cost,
        )
        self._note(left, trainer)

    def _shown(self, gaussians: Gaussians) -> Gaussians:
        """As they are rasterized, without a gradient history."""
        with torch.no_grad():
            return self.method.modulate(gaussians).detached()

    def _psnr(self, trainer: Trainer, gaussians: Gaussians, views: list[View]) -> float:
        """Of these photos as the method compares them; known noise does not count.

        `gaussians` are those to rasterize.
        """
        iteration, background = trainer.iteration, self.config.background
        degree = min(gaussians.sh_degree, self.degree(iteration))
        errors = []
        with torch.no_grad():
            for view in views:
                view = self._sized(view, iteration)
                render, _ = render_view(gaussians, view.camera, degree, background)
                image, photo, mask = self.method.compared(render, view)
                difference = (image - photo).square()
                errors.append(float((difference if mask is None else difference[mask]).double().mean()))
        return -10 * math.log10(max(float(np.mean(errors)) - self.method.noise**2, 1e-10))

    def _note(self, item: LeftOut, trainer: Trainer) -> None:
        self.state.records.append(asdict(item))
        if len(self._seconds) == WINDOW and item.seconds is None:
            self._open.append((len(self.state.records) - 1, trainer.iteration, float(np.mean(self._seconds))))

    def _close(self, iteration: int) -> None:
        """Fill in what the decisions WINDOW steps ago saved, if things stay as they are."""
        while self._open and iteration >= self._open[0][1] + WINDOW:
            index, start, before = self._open.pop(0)
            saved = before - float(np.mean(self._seconds))
            self.state.records[index]["seconds"] = max(saved, 0.0) * (self.state.length - start)
