"""The benchmark `speed`: time and memory of the rasterizer and of a training step, and how they grow."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import hqgs
from benchmarks.data import build, read_toml
from benchmarks.output import Benchmark, Report
from benchmarks.speed import tables
from benchmarks.speed.inputs import RasterInputs, load_inputs, make_inputs
from benchmarks.speed.memory import MemoryConfig, measure_memory
from benchmarks.speed.peers import measure_gsplat
from benchmarks.speed.rasterizer import RasterPass, measure, measure_threads
from benchmarks.speed.scaling import measure_scaling, scaling_chart
from benchmarks.speed.scene import make_trainer, warm_up
from benchmarks.speed.step import measure_steps, whole_step
from hqgs.training.config import METHODS, PAPER, HQGSConfig, check_method
from hqgs.training.methods.paper import VARIANTS
from hqgs.training.trainer import Trainer

DATA = read_toml(Path(__file__).with_name("speed.toml"))


@dataclass(frozen=True)
class SpeedConfig:
    """The sizes at which things are measured."""

    repeats: int  # rounds of everything that is timed
    size: tuple[int, int]  # width, height
    gaussians: tuple[int, ...]
    step_gaussians: tuple[int, ...]
    step_photos: int
    scaling_gaussians: tuple[int, ...]
    scaling_size: tuple[int, int]
    scaling_sizes: tuple[tuple[int, int], ...]
    memory: MemoryConfig
    seed: int = 2026
    method: str = "3dgs"


class Speed:
    """The parts of the benchmark; what several of them use is made once."""

    def __init__(self, config: SpeedConfig, folder: Path | None, report: Report) -> None:
        self.config = config
        self.folder = folder
        self.report = report

    @cached_property
    def inputs(self) -> list[RasterInputs]:
        c = self.config
        if self.folder is not None:
            return [load_inputs(self.folder, n) for n in c.gaussians]
        return [make_inputs(n, *c.size, c.seed) for n in c.gaussians]

    @cached_property
    def trainers(self) -> dict[str, Trainer]:
        method = self.config.method
        return {f"{method}, {n:,}": self._trainer(n, method) for n in self.config.step_gaussians}

    def _trainer(self, n: int, method: str, options: HQGSConfig | None = None) -> Trainer:
        c = self.config
        trainer = make_trainer(n, *c.size, c.step_photos, method, c.seed, options)
        warm_up(trainer)
        return trainer

    def rasterizer(self) -> None:
        rows = measure(self.inputs, self.config.repeats)
        self.report.results["rasterizer"] = rows
        self.report.tables += tables.rasterizer(rows)

    def step(self) -> None:
        self._steps("step", self.trainers)

    def _steps(self, part: str, trainers: dict[str, Trainer]) -> None:
        full = self.config.size == tuple(DATA["full"]["size"])
        rows = measure_steps(trainers, self.config.repeats, DATA["targets"] if full else {})
        self.report.results[part] = rows
        self.report.tables.append(tables.steps(rows))

    def formations(self) -> None:
        n = self.config.step_gaussians[0]
        trainers = {f"3dgs, {n:,}": self._trainer(n, "3dgs")}
        for formation in DATA["steps"]["formations"]:
            trainers[f"hqgs, {formation}"] = self._trainer(n, "hqgs", HQGSConfig(formation=formation))
        for variant in DATA["steps"]["variants"]:
            config = HQGSConfig(guidance=PAPER, paper=VARIANTS[variant])
            trainers[f"hqgs, paper's {variant}"] = self._trainer(n, "hqgs", config)
        self._steps("formations", trainers)

    def threads(self) -> None:
        if hqgs.get_num_threads() == 1:
            return self.report.leave_out("speed-up by threads", "there is one thread")
        middle, trainer = self.inputs[len(self.inputs) // 2], next(iter(self.trainers.values()))
        cases: dict[str, Callable[[], dict[str, float]]] = {
            f"rasterizer, {len(middle):,} Gaussians": RasterPass(middle),
            f"training step, {len(trainer.gaussians):,} Gaussians": whole_step(trainer),
        }
        rows = measure_threads(cases, self.config.repeats)
        self.report.results["threads"] = rows
        self.report.tables.append(tables.threads(rows))

    def scaling(self) -> None:
        c = self.config
        middle = c.gaussians[len(c.gaussians) // 2]
        scaling = measure_scaling(
            c.scaling_gaussians, c.scaling_size, c.scaling_sizes, middle, c.repeats, c.seed
        )
        self.report.results["scaling"] = scaling
        self.report.tables += tables.scaling(scaling)
        self.report.figures["scaling"] = scaling_chart(scaling)

    def memory(self) -> None:
        try:
            result = measure_memory(self.config.memory)
        except RuntimeError as error:
            return self.report.leave_out("peak memory", str(error))
        self.report.results["memory"] = result
        self.report.tables.append(tables.memory(result))

    def peers(self) -> None:
        try:
            rows = measure_gsplat(self.inputs, self.config.repeats)
        except RuntimeError as error:
            return self.report.leave_out("gsplat", str(error))
        self.report.results["gsplat"] = rows
        self.report.tables.append(tables.gsplat(rows))


PARTS = ("rasterizer", "step", "formations", "threads", "scaling", "memory", "peers")


def run(args: argparse.Namespace) -> Report:
    """Measure the parts that were asked for."""
    check_method(args.method)
    part = "quick" if args.quick else "full"
    config = build(SpeedConfig, DATA[part], f"speed.toml, {part}")
    memory = replace(config.memory, method=args.method, seed=args.seed)
    config = replace(config, method=args.method, seed=args.seed, memory=memory)
    if args.repeats is not None:
        if args.repeats < 1:
            raise ValueError(f"repeats is {args.repeats}, wanted at least 1")
        config = replace(config, repeats=args.repeats)
    report = Report(settings=asdict(config))
    speed = Speed(config, args.inputs, report)
    for part in args.parts:
        print(f"speed: {part}", file=sys.stderr)
        getattr(speed, part)()
    return report


def options(parser: argparse.ArgumentParser) -> None:
    add: Any = parser.add_argument
    add(
        "--parts",
        nargs="+",
        choices=PARTS,
        default=list(PARTS),
        metavar="PART",
        help=f"of: {', '.join(PARTS)}",
    )
    add("--repeats", type=int, metavar="N", help="rounds of each measurement (7, with --quick 3)")
    add("--method", default="3dgs", help=f"of the training step: {', '.join(METHODS)} (%(default)s)")
    add("--seed", type=int, default=2026, metavar="S", help="of the Gaussians (%(default)s)")
    add("--inputs", type=Path, metavar="DIR", help="read inputs_N.npz there for the rasterizer")


BENCHMARK = Benchmark("time and memory of the rasterizer and of a training step", options, run)
