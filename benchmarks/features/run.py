"""The benchmark `features`: what each speed feature saves in time and costs in held-out error."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.features.report import chart, compare, scene_table, verdict_table, verdicts
from benchmarks.features.switches import DEFAULT, PROTOCOLS, Feature
from benchmarks.measure import Run, exported, train
from benchmarks.output import Benchmark, Report
from benchmarks.protocol import Protocol, add_options, narrowed
from benchmarks.scenes import load_scenes
from benchmarks.speed.scene import still_config
from benchmarks.speed.timing import Seconds, interleaved
from benchmarks.study import Cell, Study, grid, open_study
from hqgs.base.files import PLY
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Trainer

REFINED_SHARE = 4  # the Gaussians that were grown once are trained on for one such part of a run
SHOWN = ("seed", "seconds", "gaussians", "history", "psnr", "refined_psnr")  # of a run, in the results


class Features:
    """The runs of all features, and steps timed on what the default run grew."""

    def __init__(self, args: argparse.Namespace, protocol: Protocol, scenes: list[Scene]) -> None:
        self.protocol = protocol
        self.rows = [row for row in protocol.rows if isinstance(row, Feature)]
        switches = {row.label: row.switch for row in self.rows}
        cells = grid(protocol, scenes, lambda row: (row.label,), lambda row: {"switch": switches[row.label]})
        self.study: Study = open_study(args, "features", cells)
        self.cells = {(cell.scene.name, cell.row.label, cell.seed): cell for cell in cells}

    def measure(self, cell: Cell, photos: Scene) -> Run:
        """Train whole, and train on what the default run grew."""
        assert isinstance(cell.row, Feature)
        with cell.row.switched():
            done = train(photos, cell.config)
        if cell.row == DEFAULT:
            path = self.grown(cell)
            path.parent.mkdir(parents=True, exist_ok=True)
            exported(done.trainer).save(path)
        psnr = done.trainer.history[-1]["psnr"]
        refined = self.refined(cell, cell.row) if cell.row.refinable else None
        return done.record() | {"psnr": psnr, "refined_psnr": refined}

    def grown(self, cell: Cell) -> Path:
        """The final Gaussians of the default run of the same scene and seed."""
        default = self.cells[cell.scene.name, DEFAULT.label, cell.seed]
        return self.study.store.beside(self.study.keys[default], PLY)

    def refined(self, cell: Cell, feature: Feature) -> float | None:
        """Held-out PSNR of the default run's final Gaussians when they are trained on, their number fixed."""
        iterations = -(-cell.config.iterations // REFINED_SHARE)
        densify = replace(cell.config.densify, stop=0)
        config = replace(cell.config, iterations=iterations, densify=densify)
        with feature.switched():
            trainer = trainer_from(cell.scene, config, Gaussians.load(self.grown(cell)))
            for _ in range(iterations):
                trainer.step()
            trainer.evaluate()
        return trainer.history[-1]["psnr"]

    def final_steps(self, scene: Scene) -> dict[str, list[Seconds]]:
        """Seconds of steps on the final Gaussians of the default run, all features in turn."""
        cell = self.cells[scene.name, DEFAULT.label, self.protocol.seeds[0]]
        final = Gaussians.load(self.grown(cell))
        return interleaved({f.label: self._timed(f, scene, final) for f in self.rows}, self.protocol.repeats)

    def _timed(self, feature: Feature, scene: Scene, final: Gaussians) -> Callable[[], Seconds]:
        config = self.protocol.train_config(feature, self.protocol.seeds[0])
        with feature.switched():
            trainer = still_trainer(scene, config, final)

        def call() -> Seconds:
            with feature.switched():
                trainer.step()  # a switch may have made new threads, without memory of their own
                before = trainer.seconds
                trainer.step()
            return {"total": trainer.seconds - before}

        return call

    def compare(self, scene: Scene) -> dict[str, Any] | None:
        """The results of a scene; None where a run of it is not finished."""
        keys = [(scene.name, f.label, seed) for f in self.rows for seed in self.protocol.seeds]
        if any(self.cells[key] not in self.study.runs for key in keys):
            return None
        runs: dict[str, list[Run]] = {f.label: [] for f in self.rows}
        for key in keys:
            run = self.study.runs[self.cells[key]]
            runs[key[1]].append({name: run[name] for name in SHOWN})
        camera = scene.train[0].camera
        return {
            "scene": scene.name,
            "width": camera.width,
            "height": camera.height,
            "iterations": self.protocol.iterations,
            "default": runs[DEFAULT.label],
            "features": compare(self.rows[1:], runs, self.final_steps(scene)),
        }


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


def run(args: argparse.Namespace) -> Report:
    """Train every scene with every feature switched, then time steps of all of them in turn."""
    protocol = PROTOCOLS["quick" if args.quick else "standard"]
    rows = None if args.rows is None else list(dict.fromkeys([DEFAULT.label, *args.rows]))
    protocol = narrowed(protocol, None, rows, args.seeds, args.iterations, args.downscale, args.repeats)
    scenes = load_scenes(args.scenes, protocol.downscale, protocol.embedded, args.out / "scenes", False)
    features = Features(args, protocol, scenes)
    if not args.finished:
        features.study.train(features.measure)
    settings = asdict(protocol) | {"scenes": [scene.name for scene in scenes]}
    report = Report(settings | features.study.circumstances(), left_out=features.study.left_out())
    results = [result for scene in scenes if (result := features.compare(scene)) is not None]
    for result in results:
        report.tables.append(scene_table(result))
        report.figures[result["scene"]] = chart(result)
    report.results = {"scenes": results, "verdicts": verdicts(features.rows[1:], results) if results else []}
    if results:
        report.tables.append(verdict_table(report.results["verdicts"]))
    return report


def options(parser: argparse.ArgumentParser) -> None:
    add_options(parser, PROTOCOLS["standard"])
    parser.add_argument("--repeats", type=int, metavar="N", help="rounds of timed steps (15, with --quick 2)")


BENCHMARK = Benchmark("what each speed feature saves in time and costs in held-out error", options, run)
