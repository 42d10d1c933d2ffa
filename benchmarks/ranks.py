"""`ranks`: the held-out error of steps of several views, at equal views seen."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pandas import DataFrame

from benchmarks.data import read_toml
from benchmarks.measure import Run, train
from benchmarks.output import Benchmark, Report, table
from benchmarks.protocol import read_protocols
from benchmarks.study import Cell, begin
from hqgs.scene.scene import Scene

FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, DATA = read_protocols(FILE), read_toml(FILE)
MEANS = ("seconds", "gaussians", "psnr", "ssim")  # over the seeds


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; what came of it, as plain JSON values."""
    done = train(photos, cell.config, evaluate=False)
    done.trainer.evaluate(done.trainer.held_out())
    last = done.trainer.history[-1]
    return done.record() | {"psnr": last["psnr"], "ssim": last["ssim"]}


def lines(runs: DataFrame) -> list[dict[str, Any]]:
    """A line for each scene and number of views, means over the seeds."""
    found = []
    for scene, row in dict.fromkeys(zip(runs["scene"], runs["row"], strict=True)):
        same = runs[(runs["scene"] == scene) & (runs["row"] == row)]
        line = {key: float(same[key].mean()) for key in MEANS}
        base = runs[(runs["scene"] == scene) & (runs["row"] == "1") & runs["seed"].isin(same["seed"])]
        difference = line["psnr"] - float(base["psnr"].mean()) if len(base) else None
        found.append(line | {"scene": scene, "row": row, "difference": difference})
    return found


def run(args: argparse.Namespace) -> Report:
    """Train what is not finished; each run is kept as soon as it is done."""
    study = begin(args, "ranks", PROTOCOLS["quick" if args.quick else "standard"])
    study.train(run_cell)
    report, runs = study.report_of_runs()
    if len(runs):
        report.results["lines"] = lines(runs)
        heading = "Steps of several views, at equal views seen"
        report.tables.append(table(heading, report.results["lines"], DATA["columns"]))
    return report


BENCHMARK = Benchmark("held-out error of steps of several views", run, PROTOCOLS)
