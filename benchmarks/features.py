"""The benchmark `features`: what each speed feature saves in time and costs in held-out error."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pandas import DataFrame

from benchmarks.command import Benchmark
from benchmarks.measure import Run, train
from benchmarks.pages.rasterizing import features_table
from benchmarks.patches import SWITCHES
from benchmarks.protocol import Row, read_protocols
from benchmarks.speed.timing import interleaved, quartiles, warmed
from benchmarks.speed.training import still_trainer, trainer_from, whole_step
from benchmarks.study import Cell, Study, begin
from hqgs.base.files import PLY
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Scene

REFINED_SHARE = 4  # the Gaussians that were grown once are trained on for one such part of a run


@dataclass(frozen=True)
class Feature(Row):
    """One choice that is made for speed, and how to train with the other one."""

    other: str = ""  # what is done instead in the run of this feature
    switch: Literal["", "float64", "boxes", "every block", "torch's loss", "torch's Adam", "one thread"] = ""
    refinable: bool = True  # whether Gaussians that were grown once and trained on can tell

    @property
    def more(self) -> dict[str, Any]:
        return {"switch": self.switch}

    def switched(self) -> Any:
        """A context manager: inside it the other choice is in place, as far as it is none of the config."""
        return SWITCHES[self.switch]()


FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS = read_protocols(FILE, Feature)
DEFAULT, *FEATURES = [row for row in PROTOCOLS["standard"].rows if isinstance(row, Feature)]


class Features:
    """The runs of all features, and steps timed on what the default run grew."""

    def __init__(self, study: Study) -> None:
        self.study, self.protocol = study, study.protocol
        self.rows = [row for row in self.protocol.rows if isinstance(row, Feature)]
        self.cells = {(cell.scene.name, cell.row.label, cell.seed): cell for cell in study.cells}

    def measure(self, cell: Cell, photos: Scene) -> Run:
        """Train whole, and train on what the default run grew."""
        assert isinstance(cell.row, Feature)
        with cell.row.switched():
            done = train(photos, cell.config)
        if cell.row == DEFAULT:
            done.trainer.model().save(self.grown(cell))
        refined = self.refined(cell, cell.row) if cell.row.refinable else None
        psnr = done.trainer.history[-1]["psnr"]
        return {"psnr": psnr, "refined_psnr": refined} | done.record()

    def grown(self, cell: Cell) -> Path:
        """The final Gaussians of the default run of the same scene and seed."""
        return self.study.beside(self.cells[cell.scene.name, DEFAULT.label, cell.seed], PLY)

    def refined(self, cell: Cell, feature: Feature) -> float | None:
        """Held-out PSNR of the default run's final Gaussians when they are trained on, their number fixed."""
        iterations = -(-cell.config.iterations // REFINED_SHARE)
        config = replace(cell.config, iterations=iterations, densify=replace(cell.config.densify, stop=0))
        with feature.switched():
            trainer = trainer_from(cell.scene, config, Gaussians.load(self.grown(cell)))
            for _ in range(iterations):
                trainer.step()
            trainer.evaluate()
        return trainer.history[-1]["psnr"]

    def final_steps(self, scene: Scene) -> dict[str, DataFrame]:
        """Seconds of steps on the final Gaussians of the default run, all features in turn."""
        cell = self.cells[scene.name, DEFAULT.label, self.protocol.seeds[0]]
        final, cases = Gaussians.load(self.grown(cell)), {}
        for feature in self.rows:
            with feature.switched():
                trainer = still_trainer(scene, self.protocol.train_config(feature, cell.seed), final)
            cases[feature.label] = warmed(whole_step(trainer), feature.switched)
        return interleaved(cases, self.protocol.repeats)

    def time_steps(self, scene: Scene) -> None:
        """Add to the lines of the first seed how many times as fast a final step is by each feature."""
        cells = {
            label: self.cells[scene.name, label, self.protocol.seeds[0]] for label in self.protocol.labels
        }
        lines = {label: self.study.runs.get(cell) for label, cell in cells.items()}
        if None in lines.values() or all(
            line and line.get("step_ratio") for line in list(lines.values())[1:]
        ):
            return
        steps = self.final_steps(scene)
        for feature in self.rows[1:]:
            rounds = steps[feature.label]["total"] / steps[DEFAULT.label]["total"]
            low, high = quartiles(rounds)
            timed = {"step_ratio": float(rounds.median()), "step_low": low, "step_high": high}
            line = dict(self.study.runs[cells[feature.label]]) | timed
            self.study.runs[cells[feature.label]] = self.study.table.put([line])[0]


def run(args: argparse.Namespace) -> list[str]:
    """Train every scene with every feature switched, then time steps of all of them in turn."""
    rows = None if args.rows is None else list(dict.fromkeys([DEFAULT.label, *args.rows]))
    features = Features(begin(args, PROTOCOLS, rows=rows))
    features.study.train(features.measure)
    if not args.finished:
        for scene in features.study.scenes:
            features.time_steps(scene)
    runs = features.study.frame()
    return [*([features_table(runs)] if len(runs) else []), *features.study.missing()]


HELP = "what each speed feature saves in time and costs in held-out error"
OPTIONS = {"--repeats": {"type": int, "metavar": "N", "help": "rounds of timed steps (15, with --quick 2)"}}
BENCHMARK = Benchmark(HELP, run, PROTOCOLS, OPTIONS)
