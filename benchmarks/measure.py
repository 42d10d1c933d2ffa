"""One training run and what it took: all that the studies read of a `Trainer`."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from hqgs.base.machine import peak_rss_mb, reset_peak_rss
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Step, Trainer

if TYPE_CHECKING:
    from benchmarks.study import Cell

Run = dict[str, Any]  # plain JSON values
# A whole run's seconds per step over those of its first steps, if there is room for more Gaussians: the
# built-in scene at 504 px takes 22 ms in its first 400 steps and 55 ms on average over 2,000.
GROWTH = 2.5
WARM, FIRST = 3, 10  # steps before the first ones that count, and how many of those


class Training:
    """A trainer, and what it took to get where it is. Raises ValueError as `Trainer` does."""

    def __init__(self, photos: Scene, config: TrainConfig) -> None:
        self._resets, started, clock = reset_peak_rss(), time.perf_counter(), time.process_time()
        self.trainer = Trainer(photos, config)
        # Of the choice of photos, diagnosis, operators, tokens.
        self.setup_seconds = time.perf_counter() - started
        self.setup_cpu_seconds = time.process_time() - clock
        self.initial_points = len(self.trainer.gaussians)
        self.cpu_seconds = 0.0  # of all threads in the steps; tells a busy machine from a slow method

    def steps(self, count: int, after: Callable[[Step], None] = lambda step: None) -> None:
        """So many steps, or to the end; raises TrainingError."""
        end = self.trainer.iteration + count
        while self.trainer.iteration < min(end, self.trainer.length):
            clock = time.process_time()
            step = self.trainer.step()
            self.cpu_seconds += time.process_time() - clock
            after(step)

    def peak_rss_mb(self) -> float | None:
        """Of all that the process held since the last call; None where the system does not tell."""
        peak = peak_rss_mb() if self._resets else None
        self._resets = reset_peak_rss()
        return peak

    def record(self) -> Run:
        """What every study keeps of a run."""
        return {
            "seed": self.trainer.config.seed,
            "iterations": self.trainer.iteration,
            "seconds": self.trainer.seconds,  # in training steps
            "cpu_seconds": self.cpu_seconds,
            "setup_seconds": self.setup_seconds,
            "history": self.trainer.history,
            "initial_points": self.initial_points,
            "gaussians": len(self.trainer.gaussians),
            "config": asdict(self.trainer.config),
        }


def train(photos: Scene, config: TrainConfig, evaluate: bool = True) -> Training:
    """Train to the end. With `evaluate` the held-out views are measured as the configuration asks and there.

    Raises ValueError as `Trainer` does, and TrainingError.
    """
    done = Training(photos, config)
    trainer = done.trainer

    def after(_: Step) -> None:
        if evaluate and trainer.iteration % trainer.config.eval_every == 0:
            trainer.evaluate()

    while trainer.iteration < trainer.length:  # which the clock may change on the way
        done.steps(trainer.length - trainer.iteration, after)
    if evaluate:
        trainer.evaluate()
    return done


class Estimate:
    """Seconds per step by scene and row: from finished runs, else from a few steps and their growth."""

    def __init__(self) -> None:
        self._finished: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
        self._first: dict[tuple[str, str], float] = {}

    def add(self, cell: Cell, run: dict[str, Any]) -> None:
        """Learn from a finished run."""
        self._finished[cell.kind].append(run["wall_seconds"] / max(run["iterations"], 1))

    def probe(self, cell: Cell, photos: Callable[[Cell], Scene]) -> None:
        """Train a few steps of a cell, on its photos, if nothing is known of it."""
        if cell.kind not in self._finished and cell.kind not in self._first:
            done = Training(photos(cell), cell.config)
            done.steps(WARM)
            before = done.trainer.seconds
            done.steps(FIRST)
            room = done.trainer.config.densify.max_gaussians / max(done.initial_points, 1)
            self._first[cell.kind] = min(GROWTH, room) * (done.trainer.seconds - before) / FIRST

    def seconds(self, cells: Iterable[Cell]) -> float:
        """What these cells will take together, as far as they are known."""
        known = self._first | {kind: float(np.mean(done)) for kind, done in self._finished.items()}
        return sum(cell.config.iterations * known.get(cell.kind, 0.0) for cell in cells)


def duration(seconds: float) -> str:
    """`45 s`, `12 min` or `3 h 05 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
