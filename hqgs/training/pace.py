"""How fast this machine trains a scene, from steps timed before a run that has so many seconds."""

from __future__ import annotations

from hqgs.training.plan import StepSeconds
from hqgs.training.trainer import Trainer


def fit_to_seconds(trainer: Trainer) -> None:
    """Plan a run that has so many seconds anew, by the time that its first steps take, and let it begin.

    Does nothing to a run without a number of seconds, or whose length is recorded. The trainer is a fresh
    one; the steps leave nothing behind.
    """
    if trainer.asked.seconds is None or trainer.asked.turn is not None:
        return
    half, full = trainer.ranks.tell([timed(trainer, True), timed(trainer, False)])[0]
    trainer.begin(trainer.prepared.plan(StepSeconds(full, half)))


def timed(trainer: Trainer, half_size: bool) -> float:
    """Mean seconds of a step's view at half or at full size."""
    if half_size and not trainer.plan.half_size_until:
        return 0.0
    for _ in range(3):  # the first ones start threads and fill caches
        trainer.step(half_size)
    started, before = trainer.seconds, trainer.iteration
    for _ in range(7):
        trainer.step(half_size)
    return (trainer.seconds - started) / (trainer.iteration - before)
