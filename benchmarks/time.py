"""`time`: the held-out error that a number of seconds gives, beside 3DGS after as many of its own."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from pandas import DataFrame

from benchmarks.measure import Run, train
from benchmarks.output import BLUE, GREEN, GREY, ORANGE, Benchmark, Report, means, panels, table, title
from benchmarks.protocol import read_protocols, read_toml
from benchmarks.study import Cell, finished
from hqgs.evaluation.held_out import held_out_means
from hqgs.evaluation.metrics import haarpsi
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.settings import with_iterations

FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, COLUMNS = read_protocols(FILE), read_toml(FILE)["columns"]
OTHERS = FILE.parents[1] / "docs" / "results" / "time_others.json"
BASE, OWN, FIRST = "3dgs", ", own points", "first commit"
MEANS = ("seconds", "iterations", "gaussians", "psnr", "ssim", "haarpsi")  # over the seeds
Curves = Mapping[str, Mapping[str, Sequence[list[dict[str, Any]]]]]  # by program and scene, of each seed
SHORT = 0.1  # dB: a level is what 3DGS ends at, less this


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; what came of it, as plain JSON values."""
    config = cell.config
    if config.seconds is not None:  # as without a number of iterations: no more than pay
        config = with_iterations(config, TrainConfig.iterations)
        config = replace(config, leave_out=(*config.leave_out, "iterations"))
    done = train(photos, config, evaluate=config.seconds is None)
    views = done.held_out()
    (mean,) = held_out_means([haarpsi], views)
    return done.judged(views) | {"haarpsi": mean}


def others() -> Curves:
    """What other programs, and the first commit that was measured here, show after their seconds."""
    return json.loads(OTHERS.read_text(encoding="utf-8"))["curves"] if OTHERS.is_file() else {}


def then(history: list[dict[str, Any]], seconds: float) -> float | None:
    """The PSNR of a run after so many of its seconds; None before its first evaluation."""
    known = [entry["psnr"] for entry in history if entry["seconds"] <= seconds]
    return known[-1] if known else None


def mean_then(histories: Sequence[list[dict[str, Any]]], seconds: float) -> float | None:
    """The mean of those that have one by then."""
    known = [value for history in histories if (value := then(history, seconds)) is not None]
    return sum(known) / len(known) if known else None


def lines(runs: DataFrame, curves: Curves) -> list[dict[str, Any]]:
    """A line for each scene and number of seconds, means over the seeds."""
    found, mean = [], means(runs, ["scene", "row"], MEANS)
    base = runs.loc[runs["row"] == BASE]
    for (scene, row), line in mean.to_dict("index").items():
        if row == BASE or row.endswith(OWN):
            continue
        asked = float(row.removesuffix(" s"))
        line |= {"name": scene, "asked": asked, "own": mean["psnr"].get((scene, f"{row}{OWN}"))}
        line["reference"] = mean_then(list(base.loc[base["scene"] == scene, "history"]), asked)
        line["first"] = first = mean_then(curves.get(FIRST, {}).get(str(scene), []), asked)
        found.append(line | {"gain": None if first is None else line["psnr"] - first})
    return found


def levels(runs: DataFrame) -> list[str]:
    """How long it takes to come within SHORT of where 3DGS ends, in words, a line for each scene."""
    words, found = [], lines(runs, {})
    base = means(runs.loc[runs["row"] == BASE], ["scene"], MEANS).to_dict("index")
    for scene, reference in base.items():
        level = reference["psnr"] - SHORT
        enough = [line["seconds"] for line in found if line["name"] == scene and line["psnr"] >= level]
        took = f"{min(enough):.0f} s" if enough else "more than were tried"
        words.append(f"{scene}: {level:.2f} dB take {took}, 3dgs {reference['seconds']:.0f} s to its end.")
    return words


def chart(runs: DataFrame, curves: Curves) -> Figure:
    """Held-out PSNR against seconds of training, a panel for each scene."""
    found, scenes = DataFrame(lines(runs, curves)), list(runs["scene"].unique())
    figure, grid = panels(4 * len(scenes), 4, 1, len(scenes))
    for axes, scene in zip(grid, scenes, strict=True):
        for (program, by_scene), color in zip(curves.items(), (GREEN, ORANGE), strict=False):
            for history in by_scene.get(str(scene), [])[:1]:
                DataFrame(history).plot("seconds", "psnr", ax=axes, color=color, label=program)
        for history in runs.loc[(runs["scene"] == scene) & (runs["row"] == BASE), "history"]:
            DataFrame(history).plot("seconds", "psnr", ax=axes, color=GREY, label=BASE)
        mine = found[found["name"] == scene]
        mine.plot("seconds", "psnr", ax=axes, color=BLUE, marker="o", label="hqgs --seconds")
        axes.set(xscale="log", xlabel="training (s)", ylabel="held-out PSNR (dB)")
        axes.set_xticks([3, 10, 30, 60, 180, 600], ["3", "10", "30", "60", "180", "600"])
        title(axes, str(scene))
    return figure


def run(args: argparse.Namespace) -> Report:
    """Train what is not finished; each run is kept as soon as it is done."""
    _, report, runs = finished(args, PROTOCOLS, run_cell)
    curves = others()
    if len(runs) and (found := lines(runs, curves)):
        report.results["lines"] = found
        report.tables += [table("Held-out error against seconds of training", found, COLUMNS), *levels(runs)]
        report.figures["error"] = chart(runs, curves)
    return report


BENCHMARK = Benchmark("held-out error against seconds of training", run, PROTOCOLS)
