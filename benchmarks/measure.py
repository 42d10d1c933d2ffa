"""One training run and what it took: all that the studies read of a `Trainer`."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hqgs.base.machine import peak_rss_mb
from hqgs.evaluation.held_out import HeldOutViews
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.forward import Step
from hqgs.training.frame import Frame
from hqgs.training.trainer import Trainer, fit_to_seconds

Run = dict[str, Any]  # plain JSON values


def reset_peak_rss() -> bool:
    """Make `peak_rss_mb` start anew from what is resident now; False where the system cannot."""
    if sys.platform != "linux":
        return False
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


class Training:
    """A trainer, and what it took to get where it is. Raises ValueError as `Trainer` does."""

    def __init__(self, photos: Scene, config: TrainConfig) -> None:
        self._resets, started, clock = reset_peak_rss(), time.perf_counter(), time.process_time()
        self.trainer = Trainer(Frame.of(photos), config)
        # Of the choice of photos, diagnosis, operators, tokens.
        self.setup_seconds = time.perf_counter() - started
        self.setup_cpu_seconds = time.process_time() - clock
        self.initial_points = len(self.trainer.gaussians)
        self.cpu_seconds = 0.0  # of all threads in the steps; tells a busy machine from a slow method

    def steps(self, count: float = math.inf, after: Callable[[Step], None] = lambda step: None) -> None:
        """So many steps, or to the end, which the clock may change on the way; raises TrainingError."""
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

    def held_out(self) -> HeldOutViews:
        return self.trainer.held_out()

    def record(self) -> Run:
        """What every study keeps of a run, columns of its line."""
        return {
            "seconds": self.trainer.seconds,  # in training steps
            "cpu_seconds": self.cpu_seconds,
            "setup_seconds": self.setup_seconds,
            "initial_points": self.initial_points,
            "gaussians": len(self.trainer.gaussians),
        }

    def judged(self, views: HeldOutViews | None = None) -> Run:
        """The record with the held-out means of where it is. `views`: its held-out views, where they are
        rendered already."""
        self.trainer.evaluate(self.held_out() if views is None else views)
        last = self.trainer.history[-1]
        return {"psnr": last["psnr"], "ssim": last["ssim"]} | self.record()

    def history(self) -> dict[str, float]:
        """Held-out PSNR by seconds of training."""
        known = [entry for entry in self.trainer.history if entry["psnr"] is not None]
        return {f"{entry['seconds']:.5g}": float(f"{entry['psnr']:.5g}") for entry in known}


def train(photos: Scene, config: TrainConfig, evaluate: bool = True) -> Training:
    """Train to the end. With `evaluate` the held-out views are measured as the configuration asks and there.

    Raises ValueError as `Trainer` does, and TrainingError.
    """
    done = Training(photos, config)
    trainer = done.trainer
    fit_to_seconds(trainer)

    def after(_: Step) -> None:
        if evaluate and trainer.iteration % trainer.config.due.eval_every == 0:
            trainer.evaluate()

    done.steps(after=after)
    if evaluate:
        trainer.evaluate()
    return done
