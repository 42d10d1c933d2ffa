"""The benchmark `speed`: time and memory of the rasterizer and of a training step, and how they grow."""

from __future__ import annotations

import argparse
import sys
from functools import cached_property
from pathlib import Path
from typing import Any

import hqgs
from benchmarks.data import read_toml
from benchmarks.output import TIMED, Benchmark, Report, UnavailableError, sizes_of, table
from benchmarks.speed.inputs import RasterInputs, make_inputs
from benchmarks.speed.rasterizer import (
    AGAINST,
    RasterPass,
    measure,
    measure_scaling,
    measure_threads,
    scaling_chart,
)
from benchmarks.speed.training import make_trainer, measure_memory, measure_steps, steps_table, whole_step
from hqgs.training.config import METHODS, PAPER, HQGSConfig, check_method
from hqgs.training.methods.paper import VARIANTS
from hqgs.training.trainer import Trainer

DATA = read_toml(Path(__file__).with_name("speed.toml"))
COLUMNS = DATA["columns"]
PARTS = ("rasterizer", "step", "formations", "threads", "scaling", "memory")
Outcome = tuple[Any, list[str]]  # what the JSON file holds of a part, and its tables


class Speed:
    """The parts of the benchmark, a method each; what several of them use is made once."""

    def __init__(self, report: Report) -> None:
        self.report, self.config = report, report.settings
        self.repeats, self.seed, self.size = (self.config[name] for name in ("repeats", "seed", "size"))

    @cached_property
    def inputs(self) -> list[RasterInputs]:
        return [make_inputs(n, *self.size, seed=self.seed) for n in self.config["gaussians"]]

    @cached_property
    def trainers(self) -> dict[str, Trainer]:
        method = self.config["method"]
        return {f"{method}, {n:,}": self._trainer(n, method) for n in self.config["step_gaussians"]}

    def _trainer(self, n: int, method: str, options: HQGSConfig | None = None) -> Trainer:
        width, height = self.size
        photos = self.config["step_photos"]
        return make_trainer(n, width, height, photos, method, self.seed, options, warm=True)

    def rasterizer(self) -> Outcome:
        rows = measure(self.inputs, self.repeats)
        size = f"{rows[0]['width']} x {rows[0]['height']}"
        title = f"Rasterizer, {size}, harmonics of degree 3, forward and backward (ms, medians)"
        work = table("Work of one pass", rows, COLUMNS["work"])
        return rows, [table(title, rows, COLUMNS["rasterizer"]), work]

    def step(self, trainers: dict[str, Trainer] | None = None) -> Outcome:
        targets = DATA["targets"] if self.size == DATA["full"]["size"] else {}
        rows = measure_steps(trainers or self.trainers, self.repeats, targets)
        return rows, [steps_table(rows)]

    def formations(self) -> Outcome:
        n, steps = self.config["step_gaussians"][0], DATA["steps"]
        options = {f"hqgs, {f}": HQGSConfig(formation=f) for f in steps["formations"]}
        options |= {
            f"hqgs, paper's {v}": HQGSConfig(guidance=PAPER, paper=VARIANTS[v]) for v in steps["variants"]
        }
        trainers = {name: self._trainer(n, "hqgs", option) for name, option in options.items()}
        return self.step({f"3dgs, {n:,}": self._trainer(n, "3dgs")} | trainers)

    def threads(self) -> Outcome:
        if hqgs.get_num_threads() == 1:
            raise UnavailableError("there is one thread")
        middle, trainer = self.inputs[len(self.inputs) // 2], next(iter(self.trainers.values()))
        cases = {
            f"rasterizer, {len(middle):,} Gaussians": RasterPass(middle),
            f"training step, {len(trainer.gaussians):,} Gaussians": whole_step(trainer),
        }
        rows = measure_threads(cases, self.repeats)
        return rows, [table("Threads", rows, COLUMNS["threads"])]

    def scaling(self) -> Outcome:
        scaling = measure_scaling(**self.config["scaling"], repeats=self.repeats, seed=self.seed)
        self.report.figures["scaling"] = scaling_chart(scaling)
        target = scaling["target_exponent"]
        rows = [scaling[name] | {"against": what, "target": target} for name, what in AGAINST.items()]
        title = "Power with which the time of forward and backward grows"
        return scaling, [table(title, rows, COLUMNS["powers"])]

    def memory(self) -> Outcome:
        result = measure_memory(self.config["memory"])
        megapixels = result["width"] * result["height"] / 1e6
        title = (
            f"Peak memory (MB = 10^6 bytes), {result['method']}, {result['gaussians']:,} Gaussians, "
            f"{result['photos']} photos of {megapixels:.2f} MP, {result['steps']} steps"
        )
        return result, [table(title, [result], COLUMNS["memory"])]


def run(args: argparse.Namespace) -> Report:
    """Measure the parts that were asked for."""
    check_method(args.method)
    config = sizes_of(DATA, args)
    same = {"method": args.method, "seed": args.seed}
    report = Report(settings=config | same | {"memory": config["memory"] | same})
    speed = Speed(report)
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
    **TIMED,
}
BENCHMARK = Benchmark("time and memory of the rasterizer and of a training step", run, options=OPTIONS)
