"""The benchmark `speed`: time and memory of the rasterizer and of a training step, and how they grow."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import hqgs
from benchmarks.command import TIMED, Benchmark, UnavailableError, sizes_of
from benchmarks.pages.figures import listed, pick
from benchmarks.pages.sections import stages_table
from benchmarks.protocol import read_toml
from benchmarks.rows import Table, facts
from benchmarks.speed.inputs import RasterInputs, make_inputs
from benchmarks.speed.rasterizer import RasterPass, measure
from benchmarks.speed.timing import Seconds, interleaved, median_ratio, using_threads, warmed, whole
from benchmarks.speed.training import make_trainer, measure_memory, measure_steps, whole_step
from hqgs.training.config import PAPER, HQGSConfig
from hqgs.training.trainer import Trainer

DATA = read_toml(Path(__file__).with_name("speed.toml"))
PARTS = ("rasterizer", "step", "formations", "threads", "memory")
SHOWN = {
    "part": ("", ""),
    "case": ("case", ""),
    "threads": ("threads", ".0f"),
    "seconds": ("ms", "ms"),
    "seconds_low": ("quartiles", "ms"),
    "seconds_high": ("", "ms"),
    "ratio": ("ratio", ".2f"),
    "peak_mb": ("peak (MB)", ",.0f"),
}
Rows = list[dict[str, Any]]


class Speed:
    """The parts of the benchmark, a method each; what several of them use is made once."""

    def __init__(self, config: dict[str, Any]) -> None:
        self.config = config
        self.repeats, self.seed, self.size = (config[name] for name in ("repeats", "seed", "size"))

    @cached_property
    def inputs(self) -> list[RasterInputs]:
        return [make_inputs(n, *self.size, seed=self.seed) for n in self.config["gaussians"]]

    @cached_property
    def trainers(self) -> dict[str, Trainer]:
        return {f"3dgs, {n:,}": self._trainer(n, "3dgs") for n in self.config["step_gaussians"]}

    def _trainer(self, n: int, method: str, options: HQGSConfig | None = None) -> Trainer:
        width, height = self.size
        photos = self.config["step_photos"]
        return make_trainer(n, width, height, photos, method, self.seed, options, warm=True)

    def rasterizer(self) -> Rows:
        return measure(self.inputs, self.repeats)

    def step(self, trainers: dict[str, Trainer] | None = None) -> Rows:
        return measure_steps(trainers or self.trainers, self.repeats)

    def formations(self) -> Rows:
        n, steps = self.config["step_gaussians"][0], DATA["steps"]
        options = {f"hqgs, {f}": HQGSConfig(formation=f) for f in steps["formations"]}
        options["hqgs, paper"] = HQGSConfig(guidance=PAPER)
        trainers = {name: self._trainer(n, "hqgs", option) for name, option in options.items()}
        return self.step({f"3dgs, {n:,}": self._trainer(n, "3dgs")} | trainers)

    def threads(self) -> Rows:
        """All sizes and a step with 1, 2, 4, ... threads and all; `ratio`: how many times as fast as one."""
        if hqgs.get_num_threads() == 1:
            raise UnavailableError("there is one thread")
        trainer = next(iter(self.trainers.values()))
        cases: dict[str, Callable[[], Seconds]] = {
            f"rasterizer, {len(x):,} Gaussians": RasterPass(x) for x in self.inputs
        }
        cases[f"training step, {len(trainer.gaussians):,} Gaussians"] = whole_step(trainer)
        most = hqgs.get_num_threads()
        counts = sorted({most, *(1 << k for k in range(most.bit_length()))})
        jobs = {
            (name, count): warmed(case, partial(using_threads, count))
            for name, case in cases.items()
            for count in counts
        }
        measured = interleaved(jobs, self.repeats)
        return [
            {
                "case": name,
                **whole(rounds),
                "ratio": median_ratio(measured[name, 1], rounds),
                "threads": count,
            }
            for (name, count), rounds in measured.items()
        ]

    def memory(self) -> Rows:
        found = measure_memory(self.config["memory"] | {"method": "3dgs", "seed": self.seed})
        sizes = {name: found[name] for name in ("gaussians", "width", "height")}
        peaks = {name: found[name] for name in ("imports_mb", "scene_mb", "peak_mb")}
        return [{"case": f"3dgs, {found['photos']} photos, {found['steps']} steps", **sizes, **peaks}]


def run(args: argparse.Namespace) -> list[str]:
    """Measure the parts that were asked for; each is written as soon as it is done."""
    speed, table = Speed(sizes_of(DATA, args)), Table(args.out / "speed.csv")
    lines, words = [], []
    for part in args.parts:
        print(f"speed: {part}", file=sys.stderr)
        try:
            rows = getattr(speed, part)()
        except UnavailableError as error:
            words.append(f"left out: {part}: {error}")
            continue
        where = facts()
        lines += table.put(
            [{"part": part} | row | where | {"threads": row.get("threads", where["threads"])} for row in rows]
        )
    if not lines:
        return words
    runs = table.frame(lines)
    tables = [listed(runs, {name: how for name, how in SHOWN.items() if name in runs})]
    if "rasterizer" in args.parts:
        tables.append(stages_table(pick(runs, part="rasterizer")))
    return [*tables, *words]


LISTED = f"of: {', '.join(PARTS)}"
OPTIONS: dict[str, dict[str, Any]] = {
    "--parts": {"nargs": "+", "choices": PARTS, "default": list(PARTS), "metavar": "PART", "help": LISTED},
    **TIMED,
}
BENCHMARK = Benchmark("time and memory of the rasterizer and of a training step", run, options=OPTIONS)
