"""`hqgs bench training`: what each speed feature saves in time and costs in held-out error."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from hqgs.bench.features import FEATURES, Feature
from hqgs.bench.output import Benchmark, Report, markdown_table
from hqgs.bench.scene import still_config
from hqgs.bench.timing import Seconds, interleaved, median_ratio, quartiles
from hqgs.camera import Scene
from hqgs.config import TrainConfig
from hqgs.data import load_scene
from hqgs.densify import DensifyConfig
from hqgs.gaussians import Gaussians
from hqgs.ply import read_ply
from hqgs.report import REPORT
from hqgs.run import CHECKPOINT, PLY, train
from hqgs.synthetic import embedded_scene
from hqgs.synthetic.scene import HEIGHT, WIDTH
from hqgs.train import Trainer

EMBEDDED = "embedded"
DEFAULT = Feature("default", "", True)
LIMIT_DB = 0.05  # what a feature that is on by default may cost, in the mean over the scenes
TRIAL_STEPS = 5  # for the first estimate of the time
GROWTH = (1.0, 4.0)  # by how much a step gets longer in the course of a run, about


@dataclass(frozen=True)
class TrainingConfig:
    """How long is trained, and how the steps are timed."""

    iterations: int = 2_000
    seeds: int = 1
    downscale: float = 1.0
    repeats: int = 15  # rounds of timed steps on the final scene
    max_gaussians: int = DensifyConfig.max_gaussians


QUICK = TrainingConfig(iterations=30, downscale=8.0, repeats=2, max_gaussians=4_500)


class Training:
    """The runs of one scene, each in a folder of its own."""

    def __init__(self, scene: Scene, config: TrainingConfig, out: Path) -> None:
        self.scene = scene
        self.config = config
        self.out = out / scene.name

    def train_config(self, feature: Feature, seed: int) -> TrainConfig:
        densify = DensifyConfig(max_gaussians=self.config.max_gaussians)
        config = TrainConfig(iterations=self.config.iterations, seed=seed, densify=densify)
        return feature.config(config.scaled())

    def folder(self, feature: Feature, seed: int) -> Path:
        return self.out / f"{feature.name.replace(' ', '_')}_{seed}"

    def finished(self, feature: Feature, seed: int) -> dict[str, Any] | None:
        """The report of a run that is done. ValueError where the folder holds a run of another kind."""
        folder = self.folder(feature, seed)
        path = folder / REPORT
        if not path.is_file():
            return None
        report = json.loads(path.read_text(encoding="utf-8"))
        wanted = json.loads(json.dumps(asdict(self.train_config(feature, seed))))
        if report["config"] != wanted:
            raise ValueError(f"{folder} holds a run with another configuration; choose another --out")
        return report if report["iterations"] == self.config.iterations else None

    def run(self, feature: Feature, seed: int) -> dict[str, Any]:
        """Train, or go on where a stopped run ended, or read the report of a finished one.

        KeyboardInterrupt if the run was stopped by Ctrl-C; its checkpoint is written then.
        """
        folder = self.folder(feature, seed)
        if (report := self.finished(feature, seed)) is None:
            print(f"bench training: {self.scene.name}, {_label(feature)}, seed {seed}", file=sys.stderr)
            with feature.switch():
                result = train(
                    self.scene, self.train_config(feature, seed), folder, resume=True, progress=False
                )
            if result.iterations < self.config.iterations:
                raise KeyboardInterrupt
            (folder / CHECKPOINT).unlink()
            report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        return {name: report[name] for name in ("seed", "seconds", "gaussians", "history")} | {
            "psnr": report["history"][-1]["psnr"]
        }

    def step_seconds(self) -> float:
        """Seconds of a step at the start of a run."""
        trainer = Trainer(self.scene, self.train_config(DEFAULT, 0))
        trainer.step()
        started = time.perf_counter()
        for _ in range(TRIAL_STEPS):
            trainer.step()
        return (time.perf_counter() - started) / TRIAL_STEPS

    def final_steps(self) -> dict[str, list[Seconds]]:
        """Seconds of steps on the final Gaussians of the default run, all features in turn."""
        final = read_ply(self.folder(DEFAULT, 0) / PLY)
        cases = {f.name: self._timed(f, final) for f in (DEFAULT, *FEATURES)}
        return interleaved(cases, self.config.repeats)

    def _timed(self, feature: Feature, final: Gaussians) -> Callable[[], Seconds]:
        with feature.switch():
            trainer = still_trainer(self.scene, self.train_config(feature, 0), final)

        def call() -> Seconds:
            with feature.switch():
                trainer.step()  # a switch may have made new threads, without memory of their own
                before = trainer.seconds
                trainer.step()
            return {"total": trainer.seconds - before}

        return call


def still_trainer(scene: Scene, config: TrainConfig, gaussians: Gaussians) -> Trainer:
    """A trainer at the given Gaussians whose steps do all the work of a step, but change next to nothing.

    The SH degree is what it is at the end of a run, and statistics for the density are gathered.
    """
    config = still_config(config, max(len(gaussians), 1))
    points = gaussians.means.numpy()
    trainer = Trainer(replace(scene, points=points, point_colors=np.zeros(points.shape, np.uint8)), config)
    with torch.no_grad():
        for name, tensor in trainer.gaussians.named().items():
            tensor.copy_(getattr(gaussians, name))
    for _ in range(config.sh_degree):
        trainer.step()
    return trainer


def compare(runs: dict[str, list[dict[str, Any]]], steps: dict[str, list[Seconds]]) -> list[dict[str, Any]]:
    """One row for each feature. `cost_db`: what the fast choice costs in held-out PSNR, run by run with the
    same seed; `speedup`: of the fast choice, over the other one."""
    default = runs[DEFAULT.name]
    rows = []
    for feature in FEATURES:
        other = runs[feature.name]
        sign = 1 if feature.by_default else -1
        costs = [sign * (b["psnr"] - a["psnr"]) for a, b in zip(default, other, strict=True)]
        seconds = [(b["seconds"] / a["seconds"]) ** sign for a, b in zip(default, other, strict=True)]
        rounds = [
            {"total": (b["total"] / a["total"]) ** sign}
            for a, b in zip(steps[DEFAULT.name], steps[feature.name], strict=True)
        ]
        rows.append(
            {
                "feature": feature.name,
                "other": feature.other,
                "by_default": feature.by_default,
                "psnr": float(np.mean([r["psnr"] for r in other])),
                "costs_db": costs,
                "cost_db": float(np.mean(costs)),
                "speedup_run": float(np.mean(seconds)),
                "speedup_step": median_ratio(rounds, [{"total": 1.0}] * len(rounds)),
                "speedup_step_quartiles": quartiles(rounds),
                "runs": other,
            }
        )
    return rows


def verdicts(scenes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean cost over the scenes, and whether the feature may be on."""
    found = []
    for k, feature in enumerate(FEATURES):
        rows = [scene["features"][k] for scene in scenes]
        costs = [cost for row in rows for cost in row["costs_db"]]
        cost = float(np.mean([row["cost_db"] for row in rows]))
        found.append(
            {
                "feature": feature.name,
                "other": feature.other,
                "by_default": feature.by_default,
                "cost_db": cost,
                "standard_error_db": float(np.std(costs, ddof=1) / np.sqrt(len(costs)))
                if costs[1:]
                else None,
                "limit_db": LIMIT_DB,
                "passed": not feature.by_default or cost <= LIMIT_DB,
            }
        )
    return found


def scene_table(scene: dict[str, Any]) -> str:
    default = scene["default"]
    psnr, seconds = (float(np.mean([r[name] for r in default])) for name in ("psnr", "seconds"))
    title = (
        f"{scene['scene']}, {scene['width']} x {scene['height']}, {scene['iterations']:,} iterations: "
        f"default {psnr:.2f} dB, {seconds:.0f} s, {default[0]['gaussians']:,} Gaussians"
    )
    body = [
        [
            row["feature"],
            "on" if row["by_default"] else "off",
            row["other"],
            f"{row['psnr']:.3f}",
            f"{row['cost_db']:+.3f}",
            f"{row['speedup_run']:.2f}",
            f"{row['speedup_step']:.2f}",
            " to ".join(f"{q:.2f}" for q in row["speedup_step_quartiles"]),
        ]
        for row in scene["features"]
    ]
    head = [
        "feature", "default", "instead", "PSNR with it (dB)", "cost (dB)", "speed-up of the run",
        "of a final step", "quartiles",
    ]  # fmt: skip
    return markdown_table(title, head, body)


def verdict_table(rows: Sequence[dict[str, Any]]) -> str:
    body = [
        [
            row["feature"],
            "on" if row["by_default"] else "off",
            f"{row['cost_db']:+.3f}",
            "" if row["standard_error_db"] is None else f"{row['standard_error_db']:.3f}",
            "pass" if row["passed"] else "FAIL",
        ]
        for row in rows
    ]
    return markdown_table(
        f"Mean cost; what is on by default may cost {LIMIT_DB} dB",
        ["feature", "default", "cost (dB)", "standard error", "verdict"],
        body,
    )


def chart(scene: dict[str, Any]) -> Figure:
    """Held-out PSNR over training seconds, a curve for each run of the first seed."""
    figure = Figure(figsize=(8, 5), dpi=150, layout="constrained")
    axes = figure.subplots()
    curves = {DEFAULT.name: scene["default"][0]}
    curves |= {f"{r['feature']}: {r['other']}": r["runs"][0] for r in scene["features"]}
    for name, run in curves.items():
        points = [(h["seconds"], h["psnr"]) for h in run["history"] if h["psnr"] is not None]
        first = name == DEFAULT.name
        axes.plot(
            *zip(*points, strict=True), label=name, lw=2.4 if first else 1.1, zorder=3 if first else 2,
            color="black" if first else None, marker="o", markersize=2.5,
        )  # fmt: skip
    axes.set(xlabel="training (s)", ylabel="held-out PSNR (dB)", title=scene["scene"])
    axes.grid(color="#dddddd", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=7)
    return figure


def _label(feature: Feature) -> str:
    return f"{feature.name}: {feature.other}" if feature.other else feature.name


def _load(path: Path, downscale: float, cache: Path) -> Scene:
    if str(path) == EMBEDDED:
        width, height = (max(1, round(side / downscale)) for side in (WIDTH, HEIGHT))
        return embedded_scene(cache / "scene", width, height)
    return load_scene(path, downscale)


def _estimate(trainings: Sequence[Training]) -> str:
    """Minutes that the runs which are left will take, from a few first steps."""
    low = 0.0
    for training in trainings:
        left = sum(
            training.finished(feature, seed) is None
            for seed in range(training.config.seeds)
            for feature in (DEFAULT, *FEATURES)
        )
        low += training.step_seconds() * training.config.iterations * left if left else 0.0
    return f"about {low * GROWTH[0] / 60:.1f} to {low * GROWTH[1] / 60:.1f} minutes of training are left"


def run(args: argparse.Namespace) -> Report:
    """Train every scene with every feature switched, then time steps of all of them in turn."""
    config = QUICK if args.quick else TrainingConfig()
    for name in ("iterations", "seeds", "repeats"):
        value = getattr(args, name)
        if value is not None:
            if value < 1:
                raise ValueError(f"{name} is {value}, wanted at least 1")
            config = replace(config, **{name: value})
    if args.downscale is not None:
        if not args.downscale >= 1:
            raise ValueError(f"downscale must be at least 1, got {args.downscale}")
        config = replace(config, downscale=args.downscale)
    paths = args.scene or [Path(EMBEDDED)]
    scenes = [_load(path, config.downscale, args.out) for path in paths]
    names = [scene.name for scene in scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"scene: the folders must have different names, got {', '.join(names)}")
    for scene in scenes:
        if not scene.test:
            raise ValueError(f"scene {scene.name!r} has no held-out view")
    trainings = [Training(scene, config, args.out) for scene in scenes]
    print(f"bench training: {_estimate(trainings)}", file=sys.stderr)

    report = Report(settings=asdict(config) | {"scenes": names})
    results = []
    for training in trainings:
        runs: dict[str, list[dict[str, Any]]] = {f.name: [] for f in (DEFAULT, *FEATURES)}
        for seed in range(config.seeds):
            for feature in (DEFAULT, *FEATURES):
                runs[feature.name].append(training.run(feature, seed))
        camera = training.scene.train[0].camera
        results.append(
            {
                "scene": training.scene.name,
                "width": camera.width,
                "height": camera.height,
                "iterations": config.iterations,
                "default": runs[DEFAULT.name],
                "features": compare(runs, training.final_steps()),
            }
        )
        report.tables.append(scene_table(results[-1]))
        report.figures[training.scene.name] = chart(results[-1])
    report.results = {"scenes": results, "verdicts": verdicts(results)}
    report.tables.append(verdict_table(report.results["verdicts"]))
    return report


def add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--scene",
        type=Path,
        nargs="+",
        action="extend",
        metavar="SCENE",
        help=f"scene folders, or {EMBEDDED!r} for the scene that is built in ({EMBEDDED})",
    )
    add("--iterations", type=int, metavar="N", help="training steps of each run (2000, with --quick 30)")
    add("--seeds", type=int, metavar="N", help="runs of each feature, with other seeds (1)")
    add("--downscale", type=float, metavar="F", help="divide the photos' sides by F (1, with --quick 8)")
    add("--repeats", type=int, metavar="N", help="rounds of timed steps (15, with --quick 2)")


BENCHMARK = Benchmark("what each speed feature saves in time and costs in held-out error", add_options, run)
