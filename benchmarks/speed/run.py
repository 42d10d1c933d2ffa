"""The benchmark `speed`: time and memory of the rasterizer and of a training step, and how they grow."""

from __future__ import annotations

import argparse
import sys
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import hqgs
from benchmarks.output import (
    LEGEND,
    TIMED,
    Benchmark,
    Report,
    UnavailableError,
    color,
    panels,
    sizes_of,
    table,
    title,
)
from benchmarks.protocol import read_toml
from benchmarks.speed.inputs import RasterInputs, fitted, make_inputs
from benchmarks.speed.rasterizer import RasterPass, measure
from benchmarks.speed.timing import exponent, interleaved, median_ratio, using_threads, warmed, whole
from benchmarks.speed.training import make_trainer, measure_memory, measure_steps, steps_table, whole_step
from hqgs.training.config import METHODS, PAPER, HQGSConfig, check_method
from hqgs.training.methods.paper import VARIANTS
from hqgs.training.trainer import Trainer

DATA = read_toml(Path(__file__).with_name("speed.toml"))
COLUMNS = DATA["columns"]
PARTS = ("rasterizer", "step", "formations", "threads", "scaling", "memory")
AGAINST = {"gaussians": "Gaussians", "pixels": "pixels"}  # what the time grows with
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
        rows = measure_steps(trainers or self.trainers, self.repeats)
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
        """Both with 1, 2, 4, ... threads and with all."""
        if hqgs.get_num_threads() == 1:
            raise UnavailableError("there is one thread")
        middle, trainer = self.inputs[len(self.inputs) // 2], next(iter(self.trainers.values()))
        cases = {
            f"rasterizer, {len(middle):,} Gaussians": RasterPass(middle),
            f"training step, {len(trainer.gaussians):,} Gaussians": whole_step(trainer),
        }
        most = hqgs.get_num_threads()
        counts = sorted({most, *(1 << k for k in range(most.bit_length()))})
        jobs = {
            (name, count): warmed(case, partial(using_threads, count))
            for name, case in cases.items()
            for count in counts
        }
        measured, rows = interleaved(jobs, self.repeats), []
        for (name, count), rounds in measured.items():
            speedup = median_ratio(measured[name, 1], rounds)  # in the same round
            row = {"case": name, "threads": count, "seconds": rounds["total"].median()}
            rows.append(row | {"speedup": speedup, "share": speedup / count})
        return rows, [table("Threads", rows, COLUMNS["threads"])]

    def scaling(self) -> Outcome:
        """Time against the number of Gaussians in one image, and of so many against the size of the image.

        The overlap per pixel is the same everywhere.
        """
        sizes, image, images, n = (
            self.config["scaling"][name] for name in ("sizes", "image", "images", "gaussians")
        )
        cloud = make_inputs(max(sizes), *image, seed=self.seed)  # the smaller ones share its memory
        by_size = self._curve({size: fitted(cloud, size, *image) for size in sizes})
        cloud = make_inputs(n, *images[0], seed=self.seed)
        by_pixels = self._curve({w * h: fitted(cloud, n, w, h) for w, h in images})
        scaling = {
            "gaussians": {"width": image[0], "height": image[1], **by_size},
            "pixels": {"gaussians": n, **by_pixels},
        }
        self.report.figures["scaling"] = scaling_chart(scaling)
        rows = [scaling[name] | {"against": what} for name, what in AGAINST.items()]
        title = "Power with which the time of forward and backward grows"
        return scaling, [table(title, rows, COLUMNS["powers"])]

    def _curve(self, inputs: dict[int, RasterInputs]) -> dict[str, Any]:
        """Seconds of passes by what they grow with."""
        measured = interleaved({x: warmed(RasterPass(one)) for x, one in inputs.items()}, self.repeats)
        rows = [whole(rounds) for rounds in measured.values()]
        curve = {name: [row[name] for row in rows] for name in ("seconds", "seconds_quartiles")}
        ends = pairwise(zip(inputs, curve["seconds"], strict=True))
        steepest = max(exponent(*zip(*two, strict=True)) for two in ends)  # between two neighbours
        found = {"exponent": exponent(list(inputs), curve["seconds"]), "steepest": steepest}
        return {"x": list(inputs), **curve, **found}

    def memory(self) -> Outcome:
        result = measure_memory(self.config["memory"])
        megapixels = result["width"] * result["height"] / 1e6
        title = (
            f"Peak memory (MB = 10^6 bytes), {result['method']}, {result['gaussians']:,} Gaussians, "
            f"{result['photos']} photos of {megapixels:.2f} MP, {result['steps']} steps"
        )
        return result, [table(title, [result], COLUMNS["memory"])]


def scaling_chart(scaling: dict[str, Any]) -> Figure:
    """Two panels: time against Gaussians and against megapixels, with the fitted power."""
    figure, grid = panels(9, 4, 1, 2, sharey=True)
    grid[0].set_ylabel("forward and backward (s)")
    first, second = (scaling[name] for name in AGAINST)
    what = (
        (first, 1, "Gaussians", f"{first['width']} x {first['height']} pixels"),
        (second, 1e6, "megapixels", f"{second['gaussians']} Gaussians"),
    )
    for k, (axes, (curve, unit, label, text)) in enumerate(zip(grid, what, strict=True)):
        x, seconds = np.array(curve["x"]) / unit, np.array(curve["seconds"])
        errors = np.abs(np.array(curve["seconds_quartiles"]).T - seconds)
        axes.errorbar(x, seconds, errors, color=color(k), marker="o", markersize=4, lw=1.6)
        line = np.exp(np.log(seconds).mean()) * (x / np.exp(np.log(x).mean())) ** curve["exponent"]
        axes.plot(x, line, color="#888888", linestyle="--", lw=1, label=f"power {curve['exponent']:.2f}")
        axes.set(xscale="log", yscale="log", xlabel=label)
        title(axes, text)
        axes.legend(**LEGEND)
    return figure


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
