"""One training iteration with everything in it, and where its time goes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.output import number
from benchmarks.places import parts_of_step
from benchmarks.speed.timing import Seconds, StageClock, interleaved, median_ratio, whole
from hqgs.base.text import markdown_table
from hqgs.training.trainer import Trainer


def whole_step(trainer: Trainer) -> Callable[[], Seconds]:
    """A step of which only the whole is timed."""
    return lambda: StageClock().seconds(trainer.step, [])


def step_by_parts(trainer: Trainer) -> Callable[[], Seconds]:
    """A step with a clock around each part."""
    clock, parts = StageClock(), parts_of_step(trainer)

    def call() -> Seconds:
        with clock.watching(parts):
            return clock.seconds(trainer.step, parts.values())

    return call


def measure_steps(
    trainers: Mapping[str, Trainer], repeats: int, targets: Mapping[str, int]
) -> list[dict[str, Any]]:
    """Seconds of a step, and the share of each part of it, for each trainer; `case` is its key.

    `targets`: milliseconds by method and number of Gaussians.
    """
    cases: dict[str, Callable[[], Seconds]] = {}
    for name, trainer in trainers.items():
        cases |= {f"{name}/whole": whole_step(trainer), f"{name}/parts": step_by_parts(trainer)}
    measured = interleaved(cases, repeats)
    first, rows = next(iter(measured.values())), []
    for name, trainer in trainers.items():
        camera = trainer.scene.train[0].camera
        method, n = trainer.config.method, len(trainer.gaussians)
        rounds, parts = measured[f"{name}/whole"], measured[f"{name}/parts"]
        stages = parts.drop(columns="total").median()
        rows.append(
            {"case": name, "method": method, "gaussians": n, "width": camera.width, "height": camera.height}
            | whole(rounds)
            | {
                "over_first": median_ratio(rounds, first),
                "target_ms": targets.get(f"{method}, {n}"),
                "clocked": median_ratio(parts, rounds),  # how much the clocks slow the step down
                "stages": stages.to_dict(),
                "percent": (100 * stages / stages.sum()).to_dict(),
                "rounds": parts.to_dict("records"),
            }
        )
    return rows


def steps_table(rows: list[dict[str, Any]]) -> str:
    """One column for each case."""
    first = rows[0]
    body = [
        ["whole step (ms)", *(number(r["seconds"], "ms") for r in rows)],
        ["quartiles (ms)", *(number(r["seconds_quartiles"], "ms") for r in rows)],
        [f"over {first['case']}", *(f"{r['over_first']:.2f}" for r in rows)],
        ["target (ms)", *(str(r["target_ms"] or "") for r in rows)],
        *([f"{part} (%)", *(f"{r['percent'][part]:.1f}" for r in rows)] for part in first["percent"]),
        ["with clocks / without", *(f"{r['clocked']:.2f}" for r in rows)],
    ]
    title = f"One training step, {first['width']} x {first['height']}"
    return markdown_table(title, ["", *(r["case"] for r in rows)], body)
