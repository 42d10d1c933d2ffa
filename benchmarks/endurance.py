"""The benchmark `endurance`: long runs, one of them with hostile rates: no NaN, memory flat, budget kept."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame

from benchmarks.command import Benchmark
from benchmarks.measure import Run, Training
from benchmarks.pages.figures import listed
from benchmarks.protocol import read_protocols
from benchmarks.study import Cell, finished
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.forward import Step
from hqgs.training.trainer import TrainingError

RECORDS = 20  # in the course of a run
LIMIT_MB = 1.0  # growth of the peak memory per 1,000 iterations, once the number of Gaussians is fixed
SHORTEST = 1_000  # iterations over which such a growth can be told from chance


PROTOCOLS = read_protocols(Path(__file__).with_suffix(".toml"))
SHOWN = {
    "row": ("case", ""),
    "loss": ("last loss", ".4f"),
    "psnr": ("PSNR (dB)", ".2f"),
    "most_gaussians": ("most Gaussians", ",.0f"),
    "peak_mb": ("peak (MB)", ",.0f"),
    "slope_mb": ("MB per 1,000", "+.2f"),
    "events": ("events", ".0f"),
    "finite": ("finite", "yes|NO"),
    "within_budget": ("in budget", "yes|NO"),
    "passed": ("verdict", "pass|FAIL"),
}
JUDGED = ["iteration", "gaussians", "values_not_finite", "losses_not_finite", "peak_mb"]  # of each record


def measure(cell: Cell, scene: Scene) -> Run:
    """Train the case of a cell."""
    return run_case(scene, cell.config)[0]


def run_case(scene: Scene, config: TrainConfig) -> tuple[Run, list[dict[str, Any]]]:
    """Train one case: the columns of its line, and the records of its course."""
    done = Training(scene, config)
    trainer, interval = done.trainer, max(1, config.iterations // RECORDS)
    records: list[dict[str, Any]] = []
    losses: list[float] = []
    failure = None

    def after(step: Step) -> None:
        losses.append(step.loss)
        if trainer.iteration % interval == 0 or trainer.iteration == config.iterations:
            records.append(_so_far(done, np.array(losses)))
            losses.clear()
            done.peak_rss_mb()  # what the evaluation needed is no part of the next one

    try:
        done.steps(config.iterations, after)
    except TrainingError as error:
        failure = str(error)
    last = records[-1] if records else {}
    result = {"records": records, "failure": failure}
    run = {name: last.get(name) for name in ("loss", "psnr", "peak_mb")} | done.record()
    run["most_gaussians"] = max((entry["gaussians"] for entry in records), default=None)
    run |= {"events": trainer.state.guard.num_events, "failure": failure} | verdict(result, config)
    return run, records


def _so_far(done: Training, losses: NDArray[np.float64]) -> dict[str, Any]:
    """`losses`: of the steps since the last record."""
    trainer, peak = done.trainer, done.peak_rss_mb()
    trainer.evaluate()
    finite = losses[np.isfinite(losses)]
    return {
        **trainer.history[-1],
        "loss": float(finite.mean()) if len(finite) else None,
        "losses_not_finite": len(losses) - len(finite),
        "values_not_finite": sum(int((~torch.isfinite(t)).sum()) for t in trainer.gaussians.named().values()),
        "peak_mb": peak,  # since the last record
    }


def verdict(result: dict[str, Any], config: TrainConfig) -> dict[str, Any]:
    """The three conditions, each True, False or None (not measured), and whether none is False.

    `slope_mb`: growth of the peak memory per 1,000 iterations in the second half, by least squares.
    """
    records = DataFrame(result["records"], columns=JUDGED)
    late = records.loc[records["iteration"] > config.iterations // 2].dropna(subset=["peak_mb"]).astype(float)
    slope = None
    if len(late) > 2 and np.ptp(late["iteration"]) >= SHORTEST:
        slope = float(np.polyfit(late["iteration"] / 1_000, late["peak_mb"], 1)[0])
    bad = records[["values_not_finite", "losses_not_finite"]].to_numpy().any()
    conditions = {
        "finite": result["failure"] is None and not bad,
        "memory_flat": None if slope is None else slope <= LIMIT_MB,
        "within_budget": bool((records["gaussians"] <= config.densify.max_gaussians).all()),
    }
    return conditions | {"slope_mb": slope, "passed": False not in conditions.values()}


def run(args: argparse.Namespace) -> list[str]:
    """Run the cases that are not finished, in their order; each is written as soon as it is done."""
    study, runs = finished(args, PROTOCOLS, measure)
    passed = len(runs) == len(study.cells) and bool(runs["passed"].all())
    words = "All passed." if passed else "NOT all passed."
    return [*([listed(runs, SHOWN)] if len(runs) else []), words, *study.missing()]


HELP = "long runs with usual and hostile rates: no NaN, flat memory, a bounded size"
BENCHMARK = Benchmark(HELP, run, PROTOCOLS)
