"""`frugality`: what leaving out saves and costs, one thing at a time and all that is automatic."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import hqgs
from benchmarks.output import Benchmark, Report
from benchmarks.scenes import BUILT_IN, EMBEDDED, load_scenes
from benchmarks.study import kept
from hqgs.base.files import write_json
from hqgs.base.machine import peak_rss_mb, reset_peak_rss
from hqgs.base.text import markdown_table
from hqgs.export.ply import write_ply
from hqgs.scene.builtin.scene import HEIGHT, WIDTH
from hqgs.scene.scene import Scene
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.config import AUTO, ITEMS, NONE, TrainConfig, parse_leave_out
from hqgs.training.frugality import RULES
from hqgs.training.trainer import Trainer

ROWS = (NONE, *ITEMS, AUTO)
TIME, BYTES, MEAN_DB, WORST_DB, DECISION = 0.5, 1 / 3, 0.05, 0.15, 0.02  # the targets, against "none"


@dataclass(frozen=True)
class FrugalityConfig:
    """What is trained."""

    iterations: int = 7_000
    downscale: float = 2.0
    seeds: int = 1
    rows: tuple[str, ...] = ROWS
    embedded: tuple[int, int, int] = (WIDTH, HEIGHT, 24)


QUICK = FrugalityConfig(iterations=30, downscale=1.0, rows=(NONE, "growth", AUTO), embedded=(48, 36, 12))


def train_config(row: str, config: FrugalityConfig, seed: int) -> TrainConfig:
    return TrainConfig(iterations=config.iterations, seed=seed, leave_out=parse_leave_out(row)).scaled()


def run_row(row: str, scene: Scene, config: TrainConfig) -> dict[str, Any]:
    """Train one row; what came of it, as plain JSON values."""
    resets = reset_peak_rss()
    clock = time.process_time()
    trainer = Trainer(scene, config)
    while trainer.iteration < trainer.length:
        trainer.step()
    cpu = time.process_time() - clock
    peak = peak_rss_mb() if resets else None
    trainer.evaluate()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        write_ply(path, trainer.method.modulate(trainer.gaussians))
        size = path.stat().st_size
    last = trainer.history[-1]
    return {
        "scene": scene.name,
        "row": row,
        "seed": config.seed,
        "photo": [scene.test[0].camera.width, scene.test[0].camera.height],
        "psnr": last["psnr"],
        "ssim": last["ssim"],
        "iterations": trainer.iteration,
        "seconds": trainer.seconds,
        "cpu_seconds": cpu,  # with the choice of photos; tells a busy machine from a slow run
        "decision_seconds": trainer.frugality.state.decisions,
        "peak_rss_mb": peak,
        "gaussians": len(trainer.gaussians),
        "sh_degree": trainer.gaussians.sh_degree,
        "bytes": size,
        "left_out": [i.known() for i in [*trainer.photos_left_out, *trainer.frugality.left_out()]],
    }


def paired(runs: Sequence[dict[str, Any]], row: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """The runs of a row, each with the one of the same scene and seed that left nothing out."""
    base = {(run["scene"], run["seed"]): run for run in runs if run["row"] == NONE}
    wanted = [(run, (run["scene"], run["seed"])) for run in runs if run["row"] == row]
    return [(run, base[key]) for run, key in wanted if key in base]


def against_none(runs: Sequence[dict[str, Any]], row: str) -> dict[str, Any] | None:
    """Means over scenes and seeds of a row's ratios and differences to "none"; None where no run has both.

    The worst scene is the one whose mean over the seeds is lowest.
    """
    if not (pairs := paired(runs, row)):
        return None
    gains: dict[str, list[float]] = {}
    for run, other in pairs:
        gains.setdefault(run["scene"], []).append(run["psnr"] - other["psnr"])
    means = [float(np.mean(of_scene)) for of_scene in gains.values()]
    return {
        "scenes": len(gains),
        "runs": len(pairs),
        "cpu_seconds": float(np.mean([a["cpu_seconds"] / b["cpu_seconds"] for a, b in pairs])),
        "bytes": float(np.mean([a["bytes"] / b["bytes"] for a, b in pairs])),
        "gaussians": float(np.mean([a["gaussians"] / b["gaussians"] for a, b in pairs])),
        "psnr": float(np.mean(means)),
        "worst_psnr": min(means),
        "ssim": float(np.mean([a["ssim"] - b["ssim"] for a, b in pairs])),
        "decision_share": float(np.mean([a["decision_seconds"] / a["seconds"] for a, _ in pairs])),
    }


def verdict(summary: dict[str, Any]) -> dict[str, bool]:
    """Which of the targets the row reaches."""
    return {
        "time": summary["cpu_seconds"] <= TIME,
        "bytes": summary["bytes"] <= BYTES,
        "mean PSNR": summary["psnr"] >= -MEAN_DB,
        "worst PSNR": summary["worst_psnr"] >= -WORST_DB,
        "decisions": summary["decision_share"] <= DECISION,
    }


def tables(runs: Sequence[dict[str, Any]], config: FrugalityConfig) -> list[str]:
    body = []
    for scene, row in dict.fromkeys((run["scene"], run["row"]) for run in runs):
        same = [run for run in runs if (run["scene"], run["row"]) == (scene, row)]

        def mean(name: str, same: list[dict[str, Any]] = same) -> float:
            return float(np.mean([run[name] for run in same]))

        psnrs = [run["psnr"] for run in same]
        body.append(
            [
                f"{scene}, {row}",
                f"{mean('psnr'):.2f}" + (f" ± {np.ptp(psnrs) / 2:.2f}" if len(same) > 1 else ""),
                f"{mean('ssim'):.4f}",
                f"{mean('cpu_seconds'):.0f}",
                f"{100 * mean('decision_seconds') / mean('seconds'):.1f} %",
                "-" if any(run["peak_rss_mb"] is None for run in same) else f"{mean('peak_rss_mb'):.0f}",
                f"{mean('gaussians'):,.0f}",
                "/".join(str(degree) for degree in sorted({run["sh_degree"] for run in same})),
                f"{mean('bytes') / 1e6:.2f}",
            ]
        )
    head = ["left out", "PSNR (dB)", "SSIM", "CPU s", "decisions", "peak (MB)", "Gaussians", "degree", "MB"]
    title = f"{config.iterations:,} iterations, photos at 1/{config.downscale:g}, held-out views"
    if config.seeds > 1:
        title += f", {config.seeds} seeds (± half the range)"
    found = [markdown_table(title, head, body)]
    rows = [(row, s) for row in config.rows if row != NONE and (s := against_none(runs, row)) is not None]
    if rows:
        body = [
            [
                row,
                f"{s['psnr']:+.2f}",
                f"{s['worst_psnr']:+.2f}",
                f"{s['ssim']:+.4f}",
                f"{s['cpu_seconds']:.2f}",
                f"{s['bytes']:.2f}",
                f"{s['gaussians']:.2f}",
            ]
            for row, s in rows
        ]
        head = ["left out", "PSNR (dB)", "worst scene", "SSIM", "CPU time", "bytes", "Gaussians"]
        found.append(markdown_table("Against none: mean differences and ratios over the scenes", head, body))
    return found


def chart(runs: Sequence[dict[str, Any]]) -> Figure:
    """PSNR gained against the share of the CPU time, and against the share of the bytes; a mark a run."""
    figure = Figure(figsize=(9, 4.2), dpi=150, layout="constrained")
    rows = [row for row in ROWS if row != NONE and paired(runs, row)]
    for axes, (name, label) in zip(
        figure.subplots(1, 2, sharey=True), (("cpu_seconds", "CPU time"), ("bytes", "bytes")), strict=True
    ):
        for k, row in enumerate(rows):
            points = [(run[name] / none[name], run["psnr"] - none["psnr"]) for run, none in paired(runs, row)]
            size = 60 if row == AUTO else 30
            axes.scatter(*zip(*points, strict=True), label=row, s=size, color=f"C{k}")
        axes.axhline(0, color="#888888", linewidth=0.8)
        axes.axvline(1, color="#888888", linewidth=0.8)
        axes.set_xlabel(f"{label}, nothing left out = 1")
        axes.set_xlim(left=0)
        axes.set_axisbelow(True)
        axes.grid(color="#dddddd", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("held-out PSNR gained (dB)")
    if rows:
        figure.axes[0].legend(frameon=False, fontsize=8, title="left out")
    return figure


def run(args: argparse.Namespace) -> Report:
    """Train what is not finished, row after row of a scene; each is kept as soon as it is done."""
    config = QUICK if args.quick else FrugalityConfig()
    changes = {n: v for n in ("iterations", "downscale", "seeds") if (v := getattr(args, n)) is not None}
    config = replace(config, **changes, **({"rows": tuple(args.rows)} if args.rows else {}))
    if unknown := [row for row in config.rows if row not in ROWS]:
        raise ValueError(f"rows: there is no {unknown[0]!r}; there are: {', '.join(ROWS)}")
    if not config.downscale >= 1:
        raise ValueError(f"downscale must be at least 1, got {config.downscale}")
    if config.seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {config.seeds}")
    cells = [
        (row, train_config(row, config, seed)) for row in config.rows for seed in range(config.seeds)
    ]  # refuses bad settings before the work
    scenes = load_scenes(args.scene, config.downscale, config.embedded, args.out / "scene", args.validate)
    runs = []
    for scene in scenes:
        fingerprint = scene_fingerprint(scene)
        for row, training in cells:
            facts = {"version": hqgs.__version__, "config": asdict(training), "scene": fingerprint}
            if training.leave_out:
                facts["rules"] = RULES
            digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]
            path = args.out / "frugality" / f"{scene.name}-{row}-s{training.seed}-{digest}.json"
            if (run := kept(path)) is None:
                print(
                    f"bench frugality: {scene.name}, {row}, seed {training.seed}", file=sys.stderr, flush=True
                )
                run = run_row(row, scene, training)
                write_json(path, run)
            runs.append(run)
    summaries = {row: s for row in config.rows if row != NONE and (s := against_none(runs, row))}
    found = tables(runs, config)
    results: dict[str, Any] = {"runs": runs, "against_none": summaries}
    if AUTO in summaries:
        reached = verdict(summaries[AUTO])
        results["targets"] = reached
        words = [f"{name}: {'reached' if ok else 'MISSED'}" for name, ok in reached.items()]
        found.append(f"Targets of {AUTO}: {', '.join(words)}.")
    settings = asdict(config) | {"scenes": [scene.name for scene in scenes], "validate": args.validate}
    return Report(settings=settings, results=results, tables=found, figures={"gains": chart(runs)})


def add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--scene",
        nargs="+",
        type=Path,
        default=[EMBEDDED],
        metavar="SCENE",
        help=f"folders, or of: {', '.join(map(str, BUILT_IN))}, which are built in (%(default)s)",
    )
    add("--rows", nargs="+", metavar="ROW", help=f"only these of: {', '.join(ROWS)}")
    add("--iterations", type=int, metavar="N", help="training steps of each run (7000, with --quick 30)")
    add("--downscale", type=float, metavar="F", help="divide the photos' sides by F (2, with --quick 1)")
    add("--seeds", type=int, metavar="N", help="runs of each row, with other seeds (1)")
    add("--validate", action="store_true", help="judge by held-back training photos: to tune")


BENCHMARK = Benchmark("what leaving out saves and costs, one thing at a time", add_options, run)
