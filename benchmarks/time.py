"""`time`: the held-out error that a number of seconds gives, beside 3DGS after as many of its own."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from benchmarks.command import Benchmark
from benchmarks.measure import Run, train
from benchmarks.pages.figures import listed
from benchmarks.protocol import read_protocols
from benchmarks.study import Cell, finished
from hqgs.evaluation.held_out import held_out_means
from hqgs.evaluation.metrics import haarpsi
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig, with_iterations

PROTOCOLS = read_protocols(Path(__file__).with_suffix(".toml"))
SHOWN = {
    "scene": ("scene", ""),
    "row": ("", ""),
    "seed": ("seed", ".0f"),
    "seconds": ("trained (s)", ".1f"),
    "trained": ("iterations", ",.0f"),
    "gaussians": ("Gaussians", ",.0f"),
    "psnr": ("PSNR (dB)", ".2f"),
    "ssim": ("SSIM", ".4f"),
}


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; the columns of its line. Runs without a number of seconds keep their history."""
    config = cell.config
    if config.seconds is not None:  # as without a number of iterations: no more than pay
        config = with_iterations(config, TrainConfig.iterations)
        config = replace(config, leave_out=(*config.leave_out, "iterations"))
    done = train(photos, config, evaluate=config.seconds is None)
    views = done.held_out()
    (mean,) = held_out_means([haarpsi], views)
    judged = {"trained": done.trainer.iteration, "haarpsi": mean} | done.judged(views)
    return judged | {"history": done.history() if config.seconds is None else None}


def run(args: argparse.Namespace) -> list[str]:
    """Train what is not finished; each run is kept as soon as it is done."""
    study, runs = finished(args, PROTOCOLS, run_cell)
    return [*([listed(runs, SHOWN)] if len(runs) else []), *study.missing()]


BENCHMARK = Benchmark("held-out error against seconds of training", run, PROTOCOLS)
