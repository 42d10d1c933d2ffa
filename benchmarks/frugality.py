"""`frugality`: what leaving out saves and costs, one thing at a time and all that is automatic."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from pandas import DataFrame

from benchmarks.measure import Run, train
from benchmarks.output import GREY, LEGEND, Benchmark, Report, color, number, paired, panels, table
from benchmarks.protocol import Protocol, read_protocols, read_toml
from benchmarks.study import Cell, finished
from hqgs.base.files import PLY
from hqgs.scene.scene import Scene
from hqgs.training.config import AUTO, NONE

FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, DATA = read_protocols(FILE), read_toml(FILE)
TARGETS, COLUMNS = DATA["targets"], DATA["columns"]
SHARES = ("cpu_seconds", "bytes", "gaussians")  # of the run that left nothing out


def run_cell(cell: Cell, photos: Scene) -> Run:
    """Train one row; what came of it, as plain JSON values."""
    done = train(photos, cell.config, evaluate=False)
    trainer, peak = done.trainer, done.peak_rss_mb()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / PLY
        trainer.shown().save(path)
        size = path.stat().st_size
    left_out = trainer.left_out()
    return done.judged() | {
        "cpu_seconds": done.setup_cpu_seconds + done.cpu_seconds,  # with the choice of photos
        "decision_seconds": trainer.frugality.memory.seconds,
        "peak_rss_mb": peak,
        "sh_degree": trainer.gaussians.sh_degree,
        "bytes": size,
        "left_out": [item.known() for item in left_out],
    }


def compared(runs: DataFrame) -> DataFrame:
    """The other runs beside those of the same scene and seed which left nothing out: shares and gains."""
    pairs = paired(runs, NONE).loc[lambda pairs: pairs["row"] != NONE]
    shares = {f"{name}_share": pairs[name] / pairs[f"{name}_base"] for name in SHARES}
    gains = {f"{name}_gain": pairs[name] - pairs[f"{name}_base"] for name in ("psnr", "ssim")}
    return pairs.assign(**shares, **gains)


def against_none(runs: DataFrame) -> dict[str, dict[str, Any]]:
    """By row the means over scenes and seeds of its ratios and differences to "none", where runs have both.

    The worst scene is the one whose mean over the seeds is lowest.
    """
    found = {}
    for row, pairs in compared(runs).groupby("row", sort=False):
        gains: Any = pairs.groupby("scene")["psnr_gain"].mean()
        found[str(row)] = {
            "scenes": len(gains),
            "runs": len(pairs),
            **{name: float(pairs[f"{name}_share"].mean()) for name in SHARES},
            "psnr": float(gains.mean()),
            "worst_psnr": float(gains.min()),
            "ssim": float(pairs["ssim_gain"].mean()),
            "decision_share": float((pairs["decision_seconds"] / pairs["seconds"]).mean()),
        }
    return found


def verdict(summary: dict[str, Any]) -> dict[str, bool]:
    """Which of the targets the row reaches."""
    return {
        target["name"]: target["sign"] * summary[key] <= target["at_most"] for key, target in TARGETS.items()
    }


def runs_table(runs: DataFrame, protocol: Protocol) -> str:
    """One line for each scene and row, means over the seeds."""
    lines = []
    for _, same in runs.groupby(["scene", "row"], sort=False):
        mean, first, psnr = same.mean(numeric_only=True), same.iloc[0], same["psnr"].astype(float)
        half = f" ± {(psnr.max() - psnr.min()) / 2:.2f}" if len(same) > 1 else ""
        words = {
            "name": f"{first['scene']}, {first['row']}",
            "psnr": number(psnr.mean(skipna=False), ".2f") + half,
            "decisions": mean["decision_seconds"] / mean["seconds"],
            "peak_rss_mb": mean.get("peak_rss_mb"),  # what no system told is no number
            "degree": "/".join(map(str, sorted(set(same["sh_degree"])))),
            "megabytes": mean["bytes"] / 1e6,
        }
        lines.append(mean.to_dict() | words)
    title = f"{protocol.iterations:,} iterations, photos at 1/{protocol.downscale:g}, held-out views"
    many = f", {len(protocol.seeds)} seeds (± half the range)" if len(protocol.seeds) > 1 else ""
    return table(title + many, lines, COLUMNS["runs"])


def chart(runs: DataFrame) -> Figure:
    """PSNR gained against the share of the CPU time, and against the share of the bytes; a mark a run."""
    figure, grid = panels(9, 4.2, 1, 2, sharey=True)
    parts = compared(runs).groupby("row", sort=False)
    for axes, (name, label) in zip(grid, (("cpu_seconds", "CPU time"), ("bytes", "bytes")), strict=True):
        for k, (row, pairs) in enumerate(parts):
            size = 60 if row == AUTO else 30
            axes.scatter(pairs[f"{name}_share"], pairs["psnr_gain"], label=str(row), s=size, color=color(k))
        axes.axhline(0, color=GREY, linewidth=0.8)
        axes.axvline(1, color=GREY, linewidth=0.8)
        axes.set_xlabel(f"{label}, nothing left out = 1")
        axes.set_xlim(left=0)
    grid[0].set_ylabel("held-out PSNR gained (dB)")
    if len(parts):
        grid[0].legend(title="left out", **LEGEND)
    return figure


def run(args: argparse.Namespace) -> Report:
    """Train what is not finished, row after row of a scene; each is kept as soon as it is done."""
    study, report, runs = finished(args, PROTOCOLS, run_cell)
    if not len(runs):
        return report
    summaries = report.results["against_none"] = against_none(runs)
    report.tables.append(runs_table(runs, study.protocol))
    if summaries:
        title = "Against none: mean differences and ratios over the scenes"
        rows = [{"row": row, **summary} for row, summary in summaries.items()]
        report.tables.append(table(title, rows, COLUMNS["against_none"]))
    if AUTO in summaries:
        reached = report.results["targets"] = verdict(summaries[AUTO])
        words = [f"{name}: {'reached' if ok else 'MISSED'}" for name, ok in reached.items()]
        report.tables.append(f"Targets of {AUTO}: {', '.join(words)}.")
    report.figures["gains"] = chart(runs)
    return report


OPTIONS = {"--validate": {"action": "store_true", "help": "judge by held-back training photos: to tune"}}
BENCHMARK = Benchmark("what leaving out saves and costs, one thing at a time", run, PROTOCOLS, OPTIONS)
