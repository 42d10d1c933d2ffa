"""The benchmark `speed`: time and memory of the rasterizer and of a training step, and how they grow."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import hqgs
from benchmarks.data import read_toml
from benchmarks.output import Benchmark, Report, UnavailableError, repeats_and_seed, with_repeats
from benchmarks.speed import tables
from benchmarks.speed.inputs import RasterInputs, make_inputs
from benchmarks.speed.rasterizer import (
    RasterPass,
    measure,
    measure_scaling,
    measure_threads,
    scaling_chart,
)
from benchmarks.speed.step import measure_steps, whole_step
from benchmarks.speed.training import make_trainer, measure_memory
from hqgs.training.config import METHODS, PAPER, HQGSConfig, check_method
from hqgs.training.methods.paper import VARIANTS
from hqgs.training.trainer import Trainer

DATA = read_toml(Path(__file__).with_name("speed.toml"))
PARTS = ("rasterizer", "step", "formations", "threads", "scaling", "memory")


class Speed:
    """The parts of the benchmark, each its rows and its tables; what several of them use is made once."""

    def __init__(self, config: dict[str, Any], report: Report) -> None:
        self.config, self.report, self.repeats = config, report, config["repeats"]

    @cached_property
    def inputs(self) -> list[RasterInputs]:
        c = self.config
        return [make_inputs(n, *c["size"], seed=c["seed"]) for n in c["gaussians"]]

    @cached_property
    def trainers(self) -> dict[str, Trainer]:
        method = self.config["method"]
        return {f"{method}, {n:,}": self._trainer(n, method) for n in self.config["step_gaussians"]}

    def _trainer(self, n: int, method: str, options: HQGSConfig | None = None) -> Trainer:
        c = self.config
        width, height = c["size"]
        return make_trainer(n, width, height, c["step_photos"], method, c["seed"], options, warm=True)

    def rasterizer(self) -> tuple[Any, list[str]]:
        rows = measure(self.inputs, self.repeats)
        return rows, tables.rasterizer(rows)

    def step(self, trainers: dict[str, Trainer] | None = None) -> tuple[Any, list[str]]:
        full = self.config["size"] == DATA["full"]["size"]
        rows = measure_steps(trainers or self.trainers, self.repeats, DATA["targets"] if full else {})
        return rows, [tables.steps(rows)]

    def formations(self) -> tuple[Any, list[str]]:
        n = self.config["step_gaussians"][0]
        trainers = {f"3dgs, {n:,}": self._trainer(n, "3dgs")}
        for formation in DATA["steps"]["formations"]:
            trainers[f"hqgs, {formation}"] = self._trainer(n, "hqgs", HQGSConfig(formation=formation))
        for variant in DATA["steps"]["variants"]:
            config = HQGSConfig(guidance=PAPER, paper=VARIANTS[variant])
            trainers[f"hqgs, paper's {variant}"] = self._trainer(n, "hqgs", config)
        return self.step(trainers)

    def threads(self) -> tuple[Any, list[str]]:
        if hqgs.get_num_threads() == 1:
            raise UnavailableError("there is one thread")
        middle, trainer = self.inputs[len(self.inputs) // 2], next(iter(self.trainers.values()))
        cases: dict[str, Callable[[], dict[str, float]]] = {
            f"rasterizer, {len(middle):,} Gaussians": RasterPass(middle),
            f"training step, {len(trainer.gaussians):,} Gaussians": whole_step(trainer),
        }
        rows = measure_threads(cases, self.repeats)
        return rows, [tables.threads(rows)]

    def scaling(self) -> tuple[Any, list[str]]:
        scaling = measure_scaling(**self.config["scaling"], repeats=self.repeats, seed=self.config["seed"])
        self.report.figures["scaling"] = scaling_chart(scaling)
        return scaling, [tables.scaling(scaling)]

    def memory(self) -> tuple[Any, list[str]]:
        result = measure_memory(self.config["memory"])
        return result, [tables.memory(result)]


def run(args: argparse.Namespace) -> Report:
    """Measure the parts that were asked for."""
    check_method(args.method)
    config = with_repeats(DATA["quick" if args.quick else "full"], args)
    same = {"method": args.method, "seed": args.seed}
    report = Report(settings=config | same | {"memory": config["memory"] | same})
    speed = Speed(report.settings, report)
    for part in args.parts:
        print(f"speed: {part}", file=sys.stderr)
        try:
            report.results[part], found = getattr(speed, part)()
            report.tables += found
        except UnavailableError as error:
            report.leave_out(part, str(error))
    return report


LISTED = f"of: {', '.join(PARTS)}"
METHOD = f"of the training step: {', '.join(METHODS)} (%(default)s)"
OPTIONS: dict[str, dict[str, Any]] = {
    "--parts": {"nargs": "+", "choices": PARTS, "default": list(PARTS), "metavar": "PART", "help": LISTED},
    "--method": {"default": "3dgs", "help": METHOD},
    **repeats_and_seed(DATA),
}
BENCHMARK = Benchmark("time and memory of the rasterizer and of a training step", run, options=OPTIONS)
