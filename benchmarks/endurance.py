"""The benchmark `endurance`: long runs, some of them on hostile scenes: no NaN, memory flat, budget kept."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame

from benchmarks.measure import Run, Training
from benchmarks.output import LEGEND, Benchmark, Report, color, panels, table
from benchmarks.protocol import Protocol, Row, read_protocols, read_toml
from benchmarks.study import Cell, finished
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Step, TrainingError

RECORDS = 20  # in the course of a run
NOISE_SHARE = 0.3  # of the training photos
LIMIT_MB = 1.0  # growth of the peak memory per 1,000 iterations, once the number of Gaussians is fixed
SHORTEST = 1_000  # iterations over which such a growth can be told from chance


def noise_photos(scene: Scene) -> Scene:
    """The scene with uniform noise in place of NOISE_SHARE of its training photos, evenly spread."""
    count = round(NOISE_SHARE * len(scene.train))
    chosen = set(np.linspace(0, len(scene.train) - 1, count).round().astype(int).tolist())
    rng = np.random.default_rng(0)
    train = [
        replace(view, image=rng.integers(0, 256, view.image.shape, np.uint8)) if k in chosen else view
        for k, view in enumerate(scene.train)
    ]
    return replace(scene, train=train)


def identical_cameras(scene: Scene) -> Scene:
    """The scene with its first training view, twice."""
    first = scene.train[0]
    return replace(scene, train=[first, replace(first, name=f"again {first.name}")])


PHOTOS: dict[str, Callable[[Scene], Scene]] = {
    "": lambda scene: scene,
    "noise": noise_photos,
    "one": lambda scene: replace(scene, train=scene.train[:1]),
    "twins": identical_cameras,
}


@dataclass(frozen=True)
class Case(Row):
    """What is done to the scene and to the configuration."""

    photos: Literal["", "noise", "one", "twins"] = ""

    @property
    def more(self) -> dict[str, Any]:
        return {"photos": self.photos}

    def train_config(self, seed: int, iterations: int, changes: dict[str, Any] | None = None) -> TrainConfig:
        """Growth ends after half of the run, so that the memory can be judged in the other half.

        A case that asks for opacity resets has some in a short run, too.
        """
        config = super().train_config(seed, iterations, changes)
        densify = replace(config.densify, stop=iterations // 2)
        if "densify" in self.config:
            densify = replace(densify, reset_every=min(densify.reset_every, max(1, densify.stop // 4)))
        return replace(config, densify=densify)


FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, COLUMNS = read_protocols(FILE, Case), read_toml(FILE)["columns"]
JUDGED = ["iteration", "gaussians", "values_not_finite", "losses_not_finite", "peak_rss_mb"]  # of each record


def measure(cell: Cell, scene: Scene) -> Run:
    """Train the case of a cell on what it makes of the scene, which the cases share."""
    return run_case(PHOTOS[cell.row.more["photos"]](scene), cell.config)


def run_case(scene: Scene, config: TrainConfig) -> Run:
    """Train one case; what it went through, as plain JSON values."""
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
    result = done.record() | {"records": records, "failure": failure, "guard": trainer.guard.summary()}
    return result | verdict(result, config)


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
        "events": trainer.guard.num_events,
        "peak_rss_mb": peak,  # since the last record
    }


def verdict(result: dict[str, Any], config: TrainConfig) -> dict[str, Any]:
    """The three conditions, each True, False or None (not measured), and whether none is False.

    `slope_mb`: growth of the peak memory per 1,000 iterations in the second half, by least squares.
    """
    records = DataFrame(result["records"], columns=JUDGED)
    late = (
        records.loc[records["iteration"] > config.iterations // 2]
        .dropna(subset=["peak_rss_mb"])
        .astype(float)
    )
    slope = None
    if len(late) > 2 and np.ptp(late["iteration"]) >= SHORTEST:
        slope = float(np.polyfit(late["iteration"] / 1_000, late["peak_rss_mb"], 1)[0])
    bad = records[["values_not_finite", "losses_not_finite"]].to_numpy().any()
    conditions = {
        "finite": result["failure"] is None and not bad,
        "memory_flat": None if slope is None else slope <= LIMIT_MB,
        "within_budget": bool((records["gaussians"] <= config.densify.max_gaussians).all()),
    }
    return conditions | {"slope_mb": slope, "passed": False not in conditions.values()}


def cases_table(results: Sequence[dict[str, Any]], protocol: Protocol) -> str:
    """One line for each case, with the last record's numbers."""
    lines = []
    for result in results:
        most = max((r["gaussians"] for r in result["records"]), default=None)
        last = (result["records"] or [dict.fromkeys(("loss", "psnr", "peak_rss_mb"))])[-1]
        lines.append(result | last | {"most": most})
    title = (
        f"Photos at 1/{protocol.downscale:g}, {protocol.iterations:,} iterations, at most "
        f"{protocol.config['densify']['max_gaussians']:,} Gaussians; memory may grow by {LIMIT_MB:g} MB per "
        "1,000 iterations"
    )
    return table(title, lines, COLUMNS)


def chart(results: Sequence[dict[str, Any]]) -> Figure:
    """Held-out PSNR, Gaussians and peak memory over the iterations, a curve for each case."""
    figure, grid = panels(8, 8, 3, sharex=True)
    what = {"psnr": "held-out PSNR (dB)", "gaussians": "Gaussians", "peak_rss_mb": "peak memory (MB)"}
    for axes, (name, label) in zip(grid, what.items(), strict=True):
        for k, result in enumerate(results):
            points = DataFrame(result["records"], columns=["iteration", name]).dropna()
            axes.plot(*points.to_numpy().T, "o-", color=color(k), label=result["case"], ms=3, lw=1.5)
        axes.set_ylabel(label)
    if results:
        grid[0].legend(**LEGEND)
    grid[-1].set_xlabel("iterations")
    return figure


def run(args: argparse.Namespace) -> Report:
    """Run the cases that are not finished, in their order; each is written as soon as it is done."""
    study, report, _ = finished(args, PROTOCOLS, measure)
    alone = len(study.scenes) == len(study.protocol.seeds) == 1
    names = {cell: cell.row.label if alone else str(cell) for cell in study.cells}
    results = [{"case": name, **study.runs[c]} for c, name in names.items() if c in study.runs]
    passed = len(results) == len(study.cells) and all(result["passed"] for result in results)
    report.settings["limit_mb"] = LIMIT_MB
    report.results = {"passed": passed, "cases": results}
    report.tables = [cases_table(results, study.protocol), "All passed." if passed else "NOT all passed."]
    report.figures["runs"] = chart(results)
    return report


HELP = "long runs on easy and hostile scenes: no NaN, flat memory, a bounded size"
BENCHMARK = Benchmark(HELP, run, PROTOCOLS)
