"""`time`: the held-out error that a number of seconds gives, beside 3DGS after as many of its own."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from pandas import DataFrame

from benchmarks.charts import GREY, LEGEND, color, panels, title
from benchmarks.data import read_toml
from benchmarks.measure import Run, train
from benchmarks.output import Benchmark, Report, table
from benchmarks.protocol import read_protocols
from benchmarks.study import Cell, begin
from hqgs.pipeline import fitted
from hqgs.scene.scene import Scene

FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, DATA = read_protocols(FILE), read_toml(FILE)
OWN = ", own points"
MEANS = ("seconds", "iterations", "gaussians", "psnr", "ssim")  # over the seeds
TICKS = (3, 10, 30, 60, 180, 600)  # s
SHORT = 0.1  # dB: a level is what 3DGS ends at, less this


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; what came of it, as plain JSON values."""
    config = fitted(photos, cell.config)
    done = train(photos, config, evaluate=config.seconds is None)
    done.trainer.evaluate(done.trainer.held_out())
    last = done.trainer.history[-1]
    return done.record() | {"psnr": last["psnr"], "ssim": last["ssim"]}


def then(history: list[dict[str, Any]], seconds: float) -> float | None:
    """The PSNR of a run after so many of its seconds; None before its first evaluation."""
    known = [entry["psnr"] for entry in history if entry["seconds"] <= seconds]
    return known[-1] if known else None


def lines(runs: DataFrame) -> list[dict[str, Any]]:
    """A line for each scene and number of seconds, means over the seeds."""
    found = []
    timed = runs[(runs["row"] != "3dgs") & ~runs["row"].str.endswith(OWN)]
    for scene, row in dict.fromkeys(zip(timed["scene"], timed["row"], strict=True)):
        same = timed[(timed["scene"] == scene) & (timed["row"] == row)]
        asked = float(row.removesuffix(" s"))
        own = runs[(runs["scene"] == scene) & (runs["row"] == f"{row}{OWN}")]
        base = runs[(runs["scene"] == scene) & (runs["row"] == "3dgs")]
        reference = [value for h in base["history"] if (value := then(h, asked)) is not None]
        found.append(
            {key: float(same[key].mean()) for key in MEANS}
            | {"name": scene, "asked": asked, "own": float(own["psnr"].mean()) if len(own) else None}
            | {"reference": sum(reference) / len(reference) if reference else None}
        )
    return found


def levels(runs: DataFrame) -> list[str]:
    """How long it takes to come within SHORT of where 3DGS ends, in words, a line for each scene."""
    words = []
    for scene, base in runs[runs["row"] == "3dgs"].groupby("scene", sort=False):
        level = float(base["psnr"].mean()) - SHORT
        mine = [line for line in lines(runs) if line["name"] == scene and line["psnr"] >= level]
        needs = min((line["seconds"] for line in mine), default=None)
        took = f"{needs:.0f} s" if needs is not None else "more than were tried"
        words.append(
            f"{scene}: {level:.2f} dB take {took}, 3dgs {float(base['seconds'].mean()):.0f} s to its end."
        )
    return words


def chart(runs: DataFrame) -> Figure:
    """Held-out PSNR against seconds of training, a panel for each scene."""
    scenes = list(dict.fromkeys(runs["scene"]))
    figure, grid = panels(5 * len(scenes), 4, 1, len(scenes))
    for axes, scene in zip(grid, scenes, strict=True):
        for _, run in runs[(runs["scene"] == scene) & (runs["row"] == "3dgs")].iterrows():
            axes.plot(
                *zip(*[(h["seconds"], h["psnr"]) for h in run["history"]], strict=True),
                color=GREY,
                label="3dgs",
            )
        mine = [line for line in lines(runs) if line["name"] == scene]
        for k, (key, label) in enumerate((("psnr", "hqgs --seconds"), ("own", "from its own points"))):
            points = [(m["seconds"], m[key]) for m in mine if m[key] is not None]
            axes.plot([x for x, _ in points], [y for _, y in points], "o-", color=color(k), label=label)
        axes.set(xscale="log", xlabel="training (s)", ylabel="held-out PSNR (dB)")
        axes.set_xticks(TICKS, list(map(str, TICKS)))
        axes.set_xticks([], minor=True)
        axes.set_xlim(TICKS[0], TICKS[-1])
        title(axes, str(scene))
    handles = dict(zip(*reversed(grid[0].get_legend_handles_labels()), strict=True))
    grid[0].legend(handles.values(), handles.keys(), **LEGEND)
    return figure


def run(args: argparse.Namespace) -> Report:
    """Train what is not finished; each run is kept as soon as it is done."""
    study = begin(args, "time", PROTOCOLS["quick" if args.quick else "standard"])
    study.train(run_cell)
    report, runs = study.report_of_runs()
    if len(runs) and (found := lines(runs)):
        report.results["lines"] = found
        report.tables += [
            table("Held-out error against seconds of training", found, DATA["columns"]),
            *levels(runs),
        ]
        report.figures["error"] = chart(runs)
    return report


BENCHMARK = Benchmark("held-out error against seconds of training", run, PROTOCOLS)
