"""`ranks`: the held-out error of steps of several views, at equal views seen."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pandas import DataFrame

from benchmarks.data import means, paired, read_toml, records
from benchmarks.measure import Run, train
from benchmarks.output import Benchmark, Report, table
from benchmarks.protocol import read_protocols
from benchmarks.study import Cell, finished
from hqgs.scene.scene import Scene

FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, COLUMNS = read_protocols(FILE), read_toml(FILE)["columns"]
BY = ["scene", "row"]


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; what came of it, as plain JSON values."""
    return train(photos, cell.config, evaluate=False).judged()


def lines(runs: DataFrame) -> list[dict[str, Any]]:
    """A line for each scene and number of views, means over the seeds."""
    pairs = paired(runs, "1")
    pairs["difference"] = pairs["psnr"] - pairs["psnr_base"]
    found = means(runs, BY, ["seconds", "gaussians", "psnr", "ssim"])
    return records(found.join(means(pairs, BY, ["difference"])))


def run(args: argparse.Namespace) -> Report:
    """Train what is not finished; each run is kept as soon as it is done."""
    _, report, runs = finished(args, PROTOCOLS, run_cell)
    if len(runs):
        report.results["lines"] = lines(runs)
        report.tables.append(table("Steps of several views, at equal views seen", lines(runs), COLUMNS))
    return report


BENCHMARK = Benchmark("held-out error of steps of several views", run, PROTOCOLS)
