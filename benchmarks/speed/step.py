"""One training iteration with everything in it, and where its time goes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from benchmarks.speed.rasterizer import CRATE, STAGES
from benchmarks.speed.timing import Seconds, StageClock, interleaved, median, median_ratio, quartiles
from hqgs.training import trainer as trainer_module
from hqgs.training.trainer import Trainer

# In the order of a step. Each is without the others that run inside it.
PARTS = (
    "activations",  # of the Gaussians, and the checks of hqgs.rasterization
    "method",  # what it makes of the Gaussians before they are rasterized
    *list(STAGES.values())[:2],
    "loss",
    "autograd",  # the backward pass of the activations, and torch's own work
    *list(STAGES.values())[2:],
    "density statistics",
    "Adam",
)

# Milliseconds of a step at 504 x 378, by method and number of Gaussians.
TARGETS = {("3dgs", 100_000): 80, ("3dgs", 200_000): 140, ("hqgs", 100_000): 90}
TARGET_SIZE = (504, 378)


def places(trainer: Trainer) -> list[tuple[Any, str, str]]:
    """Where the parts of a step are called."""
    return [
        *CRATE,
        (trainer_module, "render_view", "activations"),
        (type(trainer.method), "modulate", "method"),
        (type(trainer.method), "loss", "loss"),
        (torch.Tensor, "backward", "autograd"),
        (type(trainer.densifier), "observe", "density statistics"),
        (type(trainer.densifier), "update", "density statistics"),
        (type(trainer.optimizer), "step", "Adam"),
    ]


def whole_step(trainer: Trainer) -> Callable[[], Seconds]:
    """A step of which only the whole is timed."""
    clock = StageClock()
    return lambda: clock.seconds(trainer.step, [])


def step_by_parts(trainer: Trainer) -> Callable[[], Seconds]:
    """A step with a clock around each part."""
    clock = StageClock()

    def call() -> Seconds:
        with clock.watching(places(trainer)):
            return clock.seconds(trainer.step, PARTS)

    return call


def measure_steps(trainers: Mapping[str, Trainer], repeats: int) -> list[dict[str, Any]]:
    """Seconds of a step, and the share of each part of it, for each trainer; `case` is its key."""
    cases: dict[str, Callable[[], Seconds]] = {}
    for name, trainer in trainers.items():
        cases |= {f"{name}/whole": whole_step(trainer), f"{name}/parts": step_by_parts(trainer)}
    measured = interleaved(cases, repeats)
    rows = []
    first = measured[f"{next(iter(trainers))}/whole"]
    for name, trainer in trainers.items():
        camera = trainer.scene.train[0].camera
        method, n, size = trainer.config.method, len(trainer.gaussians), (camera.width, camera.height)
        whole, parts = measured[f"{name}/whole"], measured[f"{name}/parts"]
        stages = {part: median(parts, part) for part in (*PARTS, "rest")}
        total = sum(stages.values())
        rows.append(
            {
                "case": name,
                "method": method,
                "gaussians": n,
                "width": camera.width,
                "height": camera.height,
                "seconds": median(whole),
                "seconds_quartiles": quartiles(whole),
                "over_first": median_ratio(whole, first),
                "target_ms": TARGETS.get((method, n)) if size == TARGET_SIZE else None,
                "clocked": median_ratio(parts, whole),  # how much the clocks slow the step down
                "stages": stages,
                "percent": {stage: 100 * seconds / total for stage, seconds in stages.items()},
                "rounds": parts,
            }
        )
    return rows
