"""The benchmark `training`: what each speed feature saves in time and costs in held-out error."""

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

from benchmarks.features.features import FEATURES, Feature
from benchmarks.features.training_report import DEFAULT, chart, compare, scene_table, verdict_table, verdicts
from benchmarks.output import Benchmark, Report
from benchmarks.speed.scene import still_config
from benchmarks.speed.timing import Seconds, interleaved
from benchmarks.study import kept
from hqgs.base.files import CHECKPOINT, PLY, write_json
from hqgs.evaluation.report import REPORT
from hqgs.export.ply import read_ply
from hqgs.model.gaussians import Gaussians
from hqgs.pipeline import train
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.builtin.scene import HEIGHT, WIDTH
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.trainer import Trainer

EMBEDDED = "embedded"
TRIAL_STEPS = 5  # for the first estimate of the time
REFINED = "refined.json"
REFINED_SHARE = 4  # the Gaussians that were grown once are trained on for one such part of a run
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
        if (report := kept(path)) is None:
            return None
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
            "psnr": report["history"][-1]["psnr"],
            "refined_psnr": self.refined(feature, seed) if feature.refinable else None,
        }

    def refined(self, feature: Feature, seed: int) -> float:
        """Held-out PSNR of the default run's final Gaussians when they are trained on, their number fixed."""
        path = self.folder(feature, seed) / REFINED
        if not path.is_file():
            iterations = -(-self.config.iterations // REFINED_SHARE)
            config = self.train_config(feature, seed)
            config = replace(config, iterations=iterations, densify=replace(config.densify, stop=0))
            grown = read_ply(self.folder(DEFAULT, seed) / PLY)
            with feature.switch():
                trainer = trainer_from(self.scene, config, grown)
                for _ in range(iterations):
                    trainer.step()
                trainer.evaluate()
            write_json(path, trainer.history[-1])
        return json.loads(path.read_text(encoding="utf-8"))["psnr"]

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
    trainer = trainer_from(scene, still_config(config, max(len(gaussians), 1)), gaussians)
    for _ in range(config.sh_degree):
        trainer.step()
    return trainer


def trainer_from(scene: Scene, config: TrainConfig, gaussians: Gaussians) -> Trainer:
    """A trainer that starts with these Gaussians in place of the scene's points."""
    points = gaussians.means.numpy()
    trainer = Trainer(replace(scene, points=points, point_colors=np.zeros(points.shape, np.uint8)), config)
    with torch.no_grad():
        for name, tensor in trainer.gaussians.named().items():
            tensor.copy_(getattr(gaussians, name))
    return trainer


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
