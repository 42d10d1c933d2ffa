"""One training run and what it took: all that the studies read of a `Trainer`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hqgs.base.left_out import LeftOutRecord
from hqgs.base.machine import peak_rss_mb, reset_peak_rss
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Trainer

Run = dict[str, Any]  # plain JSON values
FIRST_STEPS = slice(3, 13)  # the steps whose median is a first step's time: warm, and before any growth


@dataclass
class Trained:
    """A trainer at its end, and what the way there took."""

    trainer: Trainer
    initial_points: int
    steps: list[float]  # seconds of each
    setup_seconds: float  # choice of photos, diagnosis, operators, tokens
    setup_cpu_seconds: float
    cpu_seconds: float  # of all threads in the steps; tells a busy machine from a slow method
    peak_rss_mb: float | None  # up to the last step, with what the process holds

    def record(self) -> Run:
        """What a study keeps of a run."""
        found = record(self.trainer, self.initial_points, self.steps)
        return found | {"cpu_seconds": self.cpu_seconds, "setup_seconds": self.setup_seconds}


def record(trainer: Trainer, initial_points: int, steps: Sequence[float]) -> Run:
    """What every study keeps of a run. `steps`: seconds of each."""
    return {
        "seed": trainer.config.seed,
        "iterations": trainer.iteration,
        "seconds": trainer.seconds,  # in training steps
        "first_step_seconds": first_step(steps),
        "history": trainer.history,
        "initial_points": initial_points,
        "gaussians": len(trainer.gaussians),
        "config": asdict(trainer.config),
    }


def train(photos: Scene, config: TrainConfig, evaluate: bool = True, at_most: int | None = None) -> Trained:
    """Train to the end, or `at_most` so many steps; evaluate there, and on the way as the configuration asks.

    Raises ValueError as `Trainer` does, and TrainingError. Without `evaluate` only the end is evaluated.
    """
    resets, started, clock = reset_peak_rss(), time.perf_counter(), time.process_time()
    trainer = Trainer(photos, config)
    setup, setup_cpu = time.perf_counter() - started, time.process_time() - clock
    first_points, steps, cpu = len(trainer.gaussians), list[float](), 0.0
    while trainer.iteration < trainer.length and trainer.iteration != at_most:
        before, clock = trainer.seconds, time.process_time()
        trainer.step()
        steps.append(trainer.seconds - before)
        cpu += time.process_time() - clock
        if evaluate and trainer.iteration % trainer.config.eval_every == 0:
            trainer.evaluate()
    peak = peak_rss_mb() if resets else None
    if at_most is None:
        trainer.evaluate()
    return Trained(trainer, first_points, steps, setup, setup_cpu, cpu, peak)


def first_step(seconds: Sequence[float]) -> float:
    """Seconds of a step before any growth."""
    return float(np.median(seconds[FIRST_STEPS] or seconds or [0.0]))


def exported(trainer: Trainer) -> Gaussians:
    """The Gaussians as a scene file gets them."""
    return trainer.shown()


def left_out(trainer: Trainer) -> list[LeftOutRecord]:
    """What the run did without, with the reasons."""
    return [item.known() for item in [*trainer.photos_left_out, *trainer.frugality.left_out()]]


def decision_seconds(trainer: Trainer) -> float:
    """Seconds that the decisions about what to leave out took."""
    return trainer.frugality.memory.seconds
