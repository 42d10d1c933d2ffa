"""The benchmark `endurance`: long runs, some of them on hostile scenes: no NaN, memory flat, budget kept."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.output import Benchmark, Report
from benchmarks.study import kept
from hqgs.base.files import write_json
from hqgs.base.machine import peak_rss_mb, reset_peak_rss
from hqgs.base.text import markdown_table
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.builtin.scene import HEIGHT, WIDTH
from hqgs.scene.scene import Scene
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.trainer import Trainer, TrainingError

RECORDS = 20  # in the course of a run
NOISE_SHARE = 0.3  # of the training photos
RATE_FACTOR = 10  # of all learning rates
RESET_EVERY = 300  # iterations, a tenth of the usual
LIMIT_MB = 1.0  # growth of the peak memory per 1,000 iterations, once the number of Gaussians is fixed
SHORTEST = 1_000  # iterations over which such a growth can be told from chance


@dataclass(frozen=True)
class EnduranceConfig:
    """How long and how large the runs are."""

    iterations: int = 20_000
    downscale: float = 4.0
    max_gaussians: int = 30_000
    seed: int = 0


QUICK = EnduranceConfig(iterations=40, downscale=12.0, max_gaussians=4_500)


@dataclass(frozen=True)
class Case:
    """What is done to the scene and to the configuration."""

    name: str
    scene: Callable[[Scene], Scene] = lambda scene: scene
    config: Callable[[TrainConfig], TrainConfig] = lambda config: config


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


def fast_rates(config: TrainConfig) -> TrainConfig:
    """The configuration with all learning rates RATE_FACTOR times as high."""
    rates = {n: RATE_FACTOR * v for n, v in vars(config).items() if n.startswith("lr_")}
    return replace(config, **rates)


def frequent_resets(config: TrainConfig) -> TrainConfig:
    """The configuration with an opacity reset every RESET_EVERY iterations, in short runs sooner."""
    every = min(RESET_EVERY, max(1, config.densify.stop // 4))
    return replace(config, densify=replace(config.densify, reset_every=every))


CASES = (
    Case("as it is"),
    Case("30 % noise photos", scene=noise_photos),
    Case("learning rates x10", config=fast_rates),
    Case("one photo", scene=lambda scene: replace(scene, train=scene.train[:1])),
    Case("two identical cameras", scene=identical_cameras),
    Case("opacity resets x10", config=frequent_resets),
)


def train_config(config: EnduranceConfig) -> TrainConfig:
    """Growth ends after half of the run, so that the memory can be judged in the other half."""
    base = TrainConfig(
        iterations=config.iterations,
        seed=config.seed,
        densify=DensifyConfig(max_gaussians=config.max_gaussians),
    ).scaled()
    return replace(base, densify=replace(base.densify, stop=config.iterations // 2))


def run_case(case: Case, scene: Scene, config: EnduranceConfig) -> dict[str, Any]:
    """Train one case; what it went through, as plain JSON values."""
    trainer = Trainer(case.scene(scene), case.config(train_config(config)))
    interval = max(1, config.iterations // RECORDS)
    records: list[dict[str, Any]] = []
    failure = None
    losses: list[float] = []
    resets = reset_peak_rss()
    try:
        while trainer.iteration < config.iterations:
            losses.append(trainer.step().loss)
            if trainer.iteration % interval == 0 or trainer.iteration == config.iterations:
                records.append(_record(trainer, losses, resets))
                losses = []
                resets = reset_peak_rss()
    except TrainingError as error:
        failure = str(error)
    result = {"case": case.name, "records": records, "failure": failure, "guard": trainer.guard.summary()}
    return result | verdict(result, config)


def _record(trainer: Trainer, losses: Sequence[float], resets: bool) -> dict[str, Any]:
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


def verdict(result: dict[str, Any], config: EnduranceConfig) -> dict[str, Any]:
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
        "within_budget": all(r["gaussians"] <= config.max_gaussians for r in records),
    }
    return conditions | {"slope_mb": slope, "passed": False not in conditions.values()}


def table(results: Sequence[dict[str, Any]], config: EnduranceConfig) -> str:
    shown = {True: "yes", False: "NO", None: "-"}
    body = []
    for result in results:
        records = result["records"]
        last = records[-1] if records else dict.fromkeys(("loss", "psnr", "peak_rss_mb"))
        body.append(
            [
                result["case"],
                _number(last["loss"], ".4f"),
                _number(last["psnr"], ".2f"),
                _number(max((r["gaussians"] for r in records), default=None), ",d"),
                _number(last["peak_rss_mb"], ".0f"),
                _number(result["slope_mb"], "+.2f"),
                str(result["guard"]["num_events"]),
                *(shown[result[name]] for name in ("finite", "memory_flat", "within_budget")),
                "pass" if result["passed"] else "FAIL",
            ]
        )
    head = [
        "case", "last loss", "PSNR (dB)", "most Gaussians", "peak (MB)", "MB per 1,000", "events",
        "finite", "memory flat", "in budget", "verdict",
    ]  # fmt: skip
    title = (
        f"Embedded scene at 1/{config.downscale:g}, {config.iterations:,} iterations, at most "
        f"{config.max_gaussians:,} Gaussians; memory may grow by {LIMIT_MB:g} MB per 1,000 iterations"
    )
    return markdown_table(title, head, body)


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def chart(results: Sequence[dict[str, Any]]) -> Figure:
    """Held-out PSNR, Gaussians and peak memory over the iterations, a curve for each case."""
    figure = Figure(figsize=(8, 8), dpi=150, layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    what = {"psnr": "held-out PSNR (dB)", "gaussians": "Gaussians", "peak_rss_mb": "peak memory (MB)"}
    for axes, (name, label) in zip(panels, what.items(), strict=True):
        for result in results:
            points = [(r["iteration"], r[name]) for r in result["records"] if r[name] is not None]
            if points:
                axes.plot(*zip(*points, strict=True), label=result["case"], lw=1.4, marker="o", markersize=2)
        axes.set_ylabel(label)
        axes.grid(color="#dddddd", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False, fontsize=7)
    panels[-1].set_xlabel("iterations")
    return figure


def finished(path: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    """The result of a case that is done; ValueError where the file is damaged or another one's."""
    if (found := kept(path)) is None:
        return None
    if found.get("settings") != settings:
        raise ValueError(f"{path} holds a case with other settings; choose another --out")
    return found["result"]


def run(args: argparse.Namespace) -> Report:
    """Run the cases that are not finished, in their order; each is written as soon as it is done."""
    config = QUICK if args.quick else EnduranceConfig()
    changes = {n: v for n in ("iterations", "downscale", "seed") if (v := getattr(args, n)) is not None}
    config = replace(config, **changes)
    if not 1 <= config.downscale <= HEIGHT / 8:
        raise ValueError(f"downscale must be in 1..{HEIGHT / 8:g}, got {config.downscale}")
    unknown = set(args.cases or ()) - {case.name for case in CASES}
    if unknown:
        raise ValueError(
            f"cases: there is no {min(unknown)!r}; there are: {', '.join(c.name for c in CASES)}"
        )
    train_config(config)  # refuses bad settings before the work
    width, height = (round(side / config.downscale) for side in (WIDTH, HEIGHT))
    scene = embedded_scene(args.out / "scene", width, height)
    settings = asdict(config)
    results = []
    for case in CASES:
        if args.cases and case.name not in args.cases:
            continue
        words = "".join(c if c.isalnum() else " " for c in case.name).split()
        path = args.out / "endurance" / f"{'_'.join(words)}.json"
        result = finished(path, settings)
        if result is None:
            print(f"bench endurance: {case.name}", file=sys.stderr, flush=True)
            result = run_case(case, scene, config)
            write_json(path, {"settings": settings, "result": result})
        results.append(result)
    passed = all(result["passed"] for result in results)
    return Report(
        settings=settings | {"limit_mb": LIMIT_MB},
        results={"passed": passed, "cases": results},
        tables=[table(results, config), "All passed." if passed else "NOT all passed."],
        figures={"runs": chart(results)},
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--iterations", type=int, metavar="N", help="training steps of each case (20000, with --quick 40)")
    add("--downscale", type=float, metavar="F", help="divide the photos' sides by F (4, with --quick 12)")
    add("--seed", type=int, metavar="S", help="of the training (0)")
    listed = ", ".join(repr(case.name) for case in CASES)
    add("--cases", nargs="+", metavar="CASE", help=f"only these of: {listed.replace('%', '%%')}")


BENCHMARK = Benchmark(
    "long runs on easy and hostile scenes: no NaN, flat memory, a bounded size", add_options, run
)
