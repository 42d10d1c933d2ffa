"""The benchmark `endurance`: long runs, some of them on hostile scenes: no NaN, memory flat, budget kept."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.charts import LEGEND, color, panels
from benchmarks.data import read_toml
from benchmarks.measure import Run, record
from benchmarks.output import Benchmark, Report, table
from benchmarks.protocol import Protocol, Row, add_options, narrowed, read_protocols
from benchmarks.scenes import load_scenes
from benchmarks.study import Cell, grid, open_study
from hqgs.base.machine import peak_rss_mb, reset_peak_rss
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Trainer, TrainingError

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

    photos: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.photos not in PHOTOS:
            raise ValueError(f"photos is {self.photos!r}, wanted one of: {', '.join(filter(None, PHOTOS))}")

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
PROTOCOLS = read_protocols(FILE, Case)


def measure(cell: Cell, scene: Scene) -> Run:
    """Train the case of a cell on what it makes of the scene, which the cases share."""
    assert isinstance(cell.row, Case)
    return run_case(PHOTOS[cell.row.photos](scene), cell.config)


def run_case(scene: Scene, config: TrainConfig) -> Run:
    """Train one case; what it went through, as plain JSON values."""
    trainer = Trainer(scene, config)
    first_points, interval = len(trainer.gaussians), max(1, config.iterations // RECORDS)
    records: list[dict[str, Any]] = []
    failure = None
    losses, steps = list[float](), list[float]()
    resets = reset_peak_rss()
    try:
        while trainer.iteration < config.iterations:
            before = trainer.seconds
            losses.append(trainer.step().loss)
            steps.append(trainer.seconds - before)
            if trainer.iteration % interval == 0 or trainer.iteration == config.iterations:
                records.append(_so_far(trainer, losses, resets))
                losses = []
                resets = reset_peak_rss()
    except TrainingError as error:
        failure = str(error)
    result = record(trainer, first_points, steps) | {"records": records, "failure": failure}
    result["guard"] = trainer.guard.summary()
    return result | verdict(result, config)


def _so_far(trainer: Trainer, losses: Sequence[float], resets: bool) -> dict[str, Any]:
    peak = peak_rss_mb() if resets else None  # before the evaluation, which needs memory of its own
    trainer.evaluate()
    tensors = trainer.gaussians.named().values()
    finite = [loss for loss in losses if math.isfinite(loss)]
    return {
        "iteration": trainer.iteration,
        "seconds": trainer.seconds,
        "loss": float(np.mean(finite)) if finite else None,  # mean over the steps since the last record
        "losses_not_finite": len(losses) - len(finite),
        "values_not_finite": sum(int((~torch.isfinite(t)).sum()) for t in tensors),
        "events": trainer.guard.num_events,
        "gaussians": len(trainer.gaussians),
        "peak_rss_mb": peak,  # since the last record
        "psnr": trainer.history[-1]["psnr"],
    }


def verdict(result: dict[str, Any], config: TrainConfig) -> dict[str, Any]:
    """The three conditions, each True, False or None (not measured), and whether none is False.

    `slope_mb`: growth of the peak memory per 1,000 iterations in the second half, by least squares.
    """
    records = result["records"]
    late = [r for r in records if r["iteration"] > config.iterations // 2 and r["peak_rss_mb"] is not None]
    slope = None
    if len(late) > 2 and late[-1]["iteration"] - late[0]["iteration"] >= SHORTEST:
        iterations, peaks = zip(*((r["iteration"] / 1_000, r["peak_rss_mb"]) for r in late), strict=True)
        slope = float(np.polyfit(iterations, peaks, 1)[0])
    conditions = {
        "finite": result["failure"] is None
        and not any(r["values_not_finite"] or r["losses_not_finite"] for r in records),
        "memory_flat": None if slope is None else slope <= LIMIT_MB,
        "within_budget": all(r["gaussians"] <= config.densify.max_gaussians for r in records),
    }
    return conditions | {"slope_mb": slope, "passed": False not in conditions.values()}


def cases_table(results: Sequence[dict[str, Any]], protocol: Protocol) -> str:
    """One line for each case, with the last record's numbers."""
    shown = {True: "yes", False: "NO", None: "–"}
    lines = []
    for result in results:
        records = result["records"] or [dict.fromkeys(("loss", "psnr", "peak_rss_mb", "gaussians"))]
        most = max((r["gaussians"] for r in result["records"]), default=None)
        lines.append(
            result
            | records[-1]
            | {name: shown[result[name]] for name in ("finite", "memory_flat", "within_budget")}
            | {"most": most, "events": result["guard"]["num_events"]}
            | {"verdict": "pass" if result["passed"] else "FAIL"}
        )
    title = (
        f"Photos at 1/{protocol.downscale:g}, {protocol.iterations:,} iterations, at most "
        f"{protocol.config['densify']['max_gaussians']:,} Gaussians; memory may grow by {LIMIT_MB:g} MB per "
        "1,000 iterations"
    )
    return table(title, lines, read_toml(FILE)["columns"]["cases"])


def chart(results: Sequence[dict[str, Any]]) -> Figure:
    """Held-out PSNR, Gaussians and peak memory over the iterations, a curve for each case."""
    figure, grid = panels(8, 8, 3, sharex=True)
    what = {"psnr": "held-out PSNR (dB)", "gaussians": "Gaussians", "peak_rss_mb": "peak memory (MB)"}
    for axes, (name, label) in zip(grid, what.items(), strict=True):
        for k, result in enumerate(results):
            points = [(r["iteration"], r[name]) for r in result["records"] if r[name] is not None]
            if points:
                axes.plot(
                    *zip(*points, strict=True), label=result["case"], color=color(k), lw=1.4, marker="o", ms=2
                )
        axes.set_ylabel(label)
    if results:
        grid[0].legend(**LEGEND)
    grid[-1].set_xlabel("iterations")
    return figure


def run(args: argparse.Namespace) -> Report:
    """Run the cases that are not finished, in their order; each is written as soon as it is done."""
    protocol = PROTOCOLS["quick" if args.quick else "standard"]
    protocol = narrowed(protocol, None, args.rows, args.seeds, args.iterations, args.downscale)
    scenes = load_scenes(args.scenes, protocol.downscale, protocol.embedded, args.out / "scenes", False)
    more = {row.label: {"photos": row.photos} for row in protocol.rows if isinstance(row, Case)}
    cells = grid(protocol, scenes, lambda row: (row.label,), lambda row: more[row.label])
    study = open_study(args, "endurance", cells)
    if not args.finished:
        study.train(measure)
    alone = len(scenes) == len(protocol.seeds) == 1
    names = {cell: cell.row.label if alone else str(cell) for cell in cells}
    results = [{"case": name, **study.runs[c]} for c, name in names.items() if c in study.runs]
    passed = len(results) == len(cells) and all(result["passed"] for result in results)
    return Report(
        settings=asdict(protocol) | {"limit_mb": LIMIT_MB} | study.circumstances(),
        results={"passed": passed, "cases": results},
        tables=[cases_table(results, protocol), "All passed." if passed else "NOT all passed."],
        figures={"runs": chart(results)},
        left_out=study.left_out(),
    )


def options(parser: argparse.ArgumentParser) -> None:
    add_options(parser, PROTOCOLS["standard"])


BENCHMARK = Benchmark(
    "long runs on easy and hostile scenes: no NaN, flat memory, a bounded size", options, run
)
