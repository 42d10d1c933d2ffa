"""`frugality`: what leaving out saves and costs, one thing at a time and all that is automatic."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.command import Benchmark
from benchmarks.measure import Run, train
from benchmarks.pages.figures import listed
from benchmarks.pages.sections import left_out
from benchmarks.protocol import read_protocols
from benchmarks.study import Cell, finished
from hqgs.base.files import PLY
from hqgs.scene.scene import Scene

PROTOCOLS = read_protocols(Path(__file__).with_suffix(".toml"))
SHOWN = {
    "scene": ("scene", ""),
    "row": ("left out", ""),
    "seed": ("seed", ".0f"),
    "psnr": ("PSNR (dB)", ".2f"),
    "cpu_seconds": ("CPU (s)", ".0f"),
    "decision_seconds": ("of it decisions", ".1f"),
    "peak_mb": ("peak (MB)", ",.0f"),
    "gaussians": ("Gaussians", ",.0f"),
    "sh_degree": ("degree", ".0f"),
    "bytes": ("bytes", ",.0f"),
}


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; the columns of its line."""
    done = train(photos, cell.config, evaluate=False)
    trainer, peak = done.trainer, done.peak_rss_mb()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / PLY
        trainer.model().save(path)
        size = path.stat().st_size
    return done.judged() | {
        "cpu_seconds": done.setup_cpu_seconds + done.cpu_seconds,  # with the choice of photos
        "decision_seconds": trainer.frugality.memory.seconds,
        "peak_mb": peak,
        "sh_degree": trainer.gaussians.sh_degree,
        "bytes": size,
    }


def run(args: argparse.Namespace) -> list[str]:
    """Train what is not finished, row after row of a scene; each is kept as soon as it is done."""
    study, runs = finished(args, PROTOCOLS, run_cell)
    base = study.protocol.baseline
    rows = [row for row in study.protocol.labels if row != base]
    tables = [listed(runs, SHOWN), left_out(runs, rows, base)] if len(runs) else []
    return [*tables, *study.missing()]


OPTIONS = {"--validate": {"action": "store_true", "help": "judge by held-back training photos: to tune"}}
BENCHMARK = Benchmark("what leaving out saves and costs, one thing at a time", run, PROTOCOLS, OPTIONS)
