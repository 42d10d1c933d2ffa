"""The benchmark `features`: what each speed feature saves in time and costs in held-out error."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pandas import DataFrame

from benchmarks.features.report import chart, compare, scene_table, verdict_table, verdicts
from benchmarks.features.switches import DEFAULT, PROTOCOLS, Feature
from benchmarks.measure import Run, train
from benchmarks.output import Benchmark, Report
from benchmarks.protocol import add_options
from benchmarks.speed.scene import still_config, trainer_from
from benchmarks.speed.timing import Seconds, interleaved
from benchmarks.study import Cell, Study, begin
from hqgs.base.files import PLY
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Trainer

REFINED_SHARE = 4  # the Gaussians that were grown once are trained on for one such part of a run
SHOWN = ("seed", "seconds", "gaussians", "history", "psnr", "refined_psnr")  # of a run, in the results


class Features:
    """The runs of all features, and steps timed on what the default run grew."""

    def __init__(self, study: Study) -> None:
        self.study = study
        self.rows = [row for row in study.protocol.rows if isinstance(row, Feature)]
        self.cells = {(cell.scene.name, cell.row.label, cell.seed): cell for cell in study.cells}

    def measure(self, cell: Cell, photos: Scene) -> Run:
        """Train whole, and train on what the default run grew."""
        assert isinstance(cell.row, Feature)
        with cell.row.switched():
            done = train(photos, cell.config)
        if cell.row == DEFAULT:
            done.trainer.shown().save(self.grown(cell))
        psnr = done.trainer.history[-1]["psnr"]
        refined = self.refined(cell, cell.row) if cell.row.refinable else None
        return done.record() | {"psnr": psnr, "refined_psnr": refined}

    def grown(self, cell: Cell) -> Path:
        """The final Gaussians of the default run of the same scene and seed."""
        return self.study.beside(self.cells[cell.scene.name, DEFAULT.label, cell.seed], PLY)

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

    def final_steps(self, scene: Scene) -> dict[str, DataFrame]:
        """Seconds of steps on the final Gaussians of the default run, all features in turn."""
        cell = self.cells[scene.name, DEFAULT.label, self.study.protocol.seeds[0]]
        final = Gaussians.load(self.grown(cell))

        def timed(feature: Feature) -> Callable[[], Seconds]:
            config = self.study.protocol.train_config(feature, cell.seed)
            with feature.switched():
                trainer = still_trainer(scene, config, final)

            def call() -> Seconds:
                with feature.switched():
                    trainer.step()  # a switch may have made new threads, without memory of their own
                    before = trainer.seconds
                    trainer.step()
                return {"total": trainer.seconds - before}

            return call

        return interleaved({f.label: timed(f) for f in self.rows}, self.study.protocol.repeats)

    def compare(self, scene: Scene) -> dict[str, Any] | None:
        """The results of a scene; None where a run of it is not finished."""
        seeds, done = self.study.protocol.seeds, self.study.runs
        cells = {f.label: [self.cells[scene.name, f.label, seed] for seed in seeds] for f in self.rows}
        if any(cell not in done for same in cells.values() for cell in same):
            return None
        runs = {label: [{n: done[c][n] for n in SHOWN} for c in same] for label, same in cells.items()}
        camera = scene.train[0].camera
        return {
            "scene": scene.name,
            "width": camera.width,
            "height": camera.height,
            "iterations": self.study.protocol.iterations,
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


def run(args: argparse.Namespace) -> Report:
    """Train every scene with every feature switched, then time steps of all of them in turn."""
    rows = None if args.rows is None else list(dict.fromkeys([DEFAULT.label, *args.rows]))
    features = Features(begin(args, "features", PROTOCOLS["quick" if args.quick else "standard"], rows=rows))
    features.study.train(features.measure)
    report = features.study.report()
    results = [found for scene in features.study.scenes if (found := features.compare(scene)) is not None]
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
