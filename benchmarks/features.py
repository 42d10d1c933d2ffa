"""The benchmark `features`: what each speed feature saves in time and costs in held-out error."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pandas import DataFrame

from benchmarks.measure import Run, train
from benchmarks.output import Benchmark, Report, number, table
from benchmarks.patches import SWITCHES
from benchmarks.protocol import Row, read_protocols, read_toml
from benchmarks.speed.timing import interleaved, quartiles, warmed
from benchmarks.speed.training import still_trainer, trainer_from, whole_step
from benchmarks.study import Cell, Study, begin
from hqgs.base.files import PLY
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Scene

REFINED_SHARE = 4  # the Gaussians that were grown once are trained on for one such part of a run
LIMIT_DB = 0.05  # what a feature that is on by default may cost, in the mean over the scenes
SURE = 2.0  # standard errors by which whole runs must be over the limit before they fail a feature
SHOWN = ("seed", "seconds", "gaussians", "history", "psnr", "refined_psnr")  # of a run, in the results


@dataclass(frozen=True)
class Feature(Row):
    """One choice that is made for speed, and how to train with the other one."""

    other: str = ""  # what is done instead in the run of this feature
    by_default: bool = True  # whether the product has it on
    switch: Literal["", "float64", "boxes", "every block", "torch's loss", "torch's Adam", "one thread"] = ""
    refinable: bool = True  # whether Gaussians that were grown once and trained on can tell

    @property
    def more(self) -> dict[str, Any]:
        return {"switch": self.switch}

    def switched(self) -> Any:
        """A context manager: inside it the other choice is in place, as far as it is none of the config."""
        return SWITCHES[self.switch]()


FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, COLUMNS = read_protocols(FILE, Feature), read_toml(FILE)["columns"]
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

    def compare(self, scene: Scene) -> dict[str, Any] | None:
        """The results of a scene; None where a run of it is not finished."""
        runs: dict[str, list[Run]] = {feature.label: [] for feature in self.rows}
        for cell in self.study.cells:
            if cell.scene is scene:
                if cell not in self.study.runs:
                    return None
                runs[cell.row.label].append({name: self.study.runs[cell][name] for name in SHOWN})
        camera = scene.train[0].camera
        return {
            "scene": scene.name,
            "width": camera.width,
            "height": camera.height,
            "iterations": self.protocol.iterations,
            "default": runs[DEFAULT.label],
            "features": compare(self.rows[1:], runs, self.final_steps(scene)),
        }


def compare(
    features: Sequence[Feature], runs: dict[str, list[dict[str, Any]]], steps: dict[str, DataFrame]
) -> list[dict[str, Any]]:
    """One row for each feature, from runs that hold `psnr`, `refined_psnr` and `seconds`.

    `costs_db`: what the fast choice costs in held-out PSNR, run by run with the same seed, and
    `refined_costs_db` the same of the Gaussians that were grown once and trained on, empty where they cannot
    tell; `cost_db` and `refined_cost_db` their means. `speedup`: of the fast choice, over the other one.
    """
    rows, fast = [], DataFrame(runs[DEFAULT.label])
    for feature in features:
        other, sign = DataFrame(runs[feature.label]), 1 if feature.by_default else -1
        row: dict[str, Any] = {"feature": feature.label, "other": feature.other}
        row |= {"by_default": feature.by_default, "psnr": float(other["psnr"].mean())}
        for kind in ("", "refined_"):
            costs = sign * (other[f"{kind}psnr"].astype(float) - fast[f"{kind}psnr"]).dropna()
            row[f"{kind}costs_db"] = costs.tolist()
            row[f"{kind}cost_db"] = float(costs.mean()) if len(costs) else None
        rounds = (steps[feature.label]["total"] / steps[DEFAULT.label]["total"]) ** sign
        row["speedup_run"] = float(((other["seconds"] / fast["seconds"]) ** sign).mean())
        row |= {"speedup_step": rounds.median(), "speedup_step_quartiles": quartiles(rounds)}
        rows.append(row | {"runs": runs[feature.label]})
    return rows


def verdicts(scenes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean costs over the scenes, and whether the feature may be on.

    Growth decides by thresholds, so that a change of one bit makes other Gaussians: whole runs scatter by
    more than the limit. They fail a feature only where they are sure to be over it; the Gaussians that were
    grown once and trained on with either choice scatter little, and are held against the limit itself.
    """
    found = []
    for rows in zip(*(scene["features"] for scene in scenes), strict=True):  # of one feature
        entry = {name: rows[0][name] for name in ("feature", "other", "by_default")} | {"limit_db": LIMIT_DB}
        for kind in ("", "refined_"):
            costs = [cost for row in rows for cost in row[f"{kind}costs_db"]]
            error = float(np.std(costs, ddof=1) / np.sqrt(len(costs))) if costs[1:] else None
            entry[f"{kind}cost_db"] = float(np.mean(costs)) if costs else None
            entry[f"{kind}standard_error_db"] = error
        sure = entry["cost_db"] - SURE * (entry["standard_error_db"] or 0.0)
        worst = max(sure, -np.inf if entry["refined_cost_db"] is None else entry["refined_cost_db"])
        found.append(entry | {"passed": not entry["by_default"] or bool(worst <= LIMIT_DB)})
    return found


def scene_table(scene: dict[str, Any]) -> str:
    default = DataFrame(scene["default"])
    title = (
        f"{scene['scene']}, {scene['width']} x {scene['height']}, {scene['iterations']:,} iterations: "
        f"default {default['psnr'].mean():.2f} dB, {default['seconds'].mean():.0f} s, "
        f"{default['gaussians'][0]:,} Gaussians"
    )
    return table(title, scene["features"], COLUMNS["of_scene"])


def verdict_table(rows: Sequence[dict[str, Any]]) -> str:
    def with_error(row: dict[str, Any], kind: str) -> str:
        error = row[f"{kind}standard_error_db"]
        return number(row[f"{kind}cost_db"], "+.3f") + ("" if error is None else f" ± {error:.3f}")

    lines = [row | {"cost": with_error(row, ""), "refined": with_error(row, "refined_")} for row in rows]
    title = f"Mean cost with its standard error; what is on by default may cost {LIMIT_DB} dB"
    return table(title, lines, COLUMNS["of_all"])


def run(args: argparse.Namespace) -> Report:
    """Train every scene with every feature switched, then time steps of all of them in turn."""
    rows = None if args.rows is None else list(dict.fromkeys([DEFAULT.label, *args.rows]))
    features = Features(begin(args, PROTOCOLS, rows=rows))
    features.study.train(features.measure)
    report = features.study.report()
    results = [found for scene in features.study.scenes if (found := features.compare(scene)) is not None]
    report.results = {"scenes": results, "verdicts": verdicts(results)}
    report.tables += map(scene_table, results)
    if results:
        report.tables.append(verdict_table(report.results["verdicts"]))
    return report


HELP = "what each speed feature saves in time and costs in held-out error"
OPTIONS = {"--repeats": {"type": int, "metavar": "N", "help": "rounds of timed steps (15, with --quick 2)"}}
BENCHMARK = Benchmark(HELP, run, PROTOCOLS, OPTIONS)
