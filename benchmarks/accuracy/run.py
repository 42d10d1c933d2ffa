"""The benchmark `accuracy`: the error against the run time of every knob of the rasterizer."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import hqgs
from benchmarks.accuracy.errors import errors_against, pareto_front
from benchmarks.accuracy.knobs import CASES, DEFINED, EXACT, Knobs, TunedPass
from benchmarks.accuracy.trained import trained_inputs
from benchmarks.output import Benchmark, Report
from benchmarks.speed.inputs import SIZE, RasterInputs, make_inputs
from benchmarks.speed.rasterizer import measure_threads, thread_counts
from benchmarks.speed.timing import interleaved, median, quartiles
from hqgs.base.text import markdown_table

Row = dict[str, Any]
ORACLES = {"exact": EXACT, "defined": DEFINED}
ERRORS: dict[str, Callable[[Row], float]] = {  # of a row and an oracle's name; what the panels show
    "image": lambda errors: errors["image"]["rms"],
    "gradients": lambda errors: errors["gradients"]["all"]["relative"],
}


@dataclass(frozen=True)
class AccuracyConfig:
    """The sizes at which things are measured."""

    repeats: int = 15  # rounds of everything that is timed
    seed: int = 2026
    size: tuple[int, int] = SIZE  # width, height
    gaussians: tuple[int, ...] = (10_000, 100_000)
    trained_views: int = 24  # of the built-in scene
    trained_steps: int = 500
    trained_gaussians: int = 200_000  # at most


QUICK = AccuracyConfig(
    repeats=2,
    size=(64, 48),
    gaussians=(500,),
    trained_views=6,
    trained_steps=20,
    trained_gaussians=4_500,
)


def measure(name: str, inputs: RasterInputs, repeats: int) -> dict[str, Any]:
    """Errors and seconds of every case on the same numbers; the seconds of a round are taken in turn."""
    passes = [TunedPass(inputs, knobs) for _, _, knobs in CASES]
    oracles = {oracle: TunedPass(inputs, knobs).outputs() for oracle, knobs in ORACLES.items()}
    found = []
    for case in passes:
        outputs = case.outputs()
        found.append({oracle: errors_against(outputs, exact) for oracle, exact in oracles.items()})
    measured = list(interleaved({str(k): p for k, p in enumerate(passes)}, repeats).values())
    rows = []
    for (knob, value, knobs), case, errors, rounds in zip(CASES, passes, found, measured, strict=True):
        ratios = [a["total"] / b["total"] for a, b in zip(rounds, measured[0], strict=True)]
        rows.append(
            {
                "knob": knob,
                "value": value,
                "settings": asdict(knobs),
                "seconds": median(rounds),
                "seconds_quartiles": quartiles(rounds),
                "ratio": float(np.median(ratios)),  # to the default, in the same round
                "ratio_quartiles": [float(q) for q in np.quantile(ratios, [0.25, 0.75])],
                "tile_pairs": case.work[0],
                "blocks": case.work[1],
                "errors": errors,
            }
        )
    return {
        "inputs": name,
        "gaussians": len(inputs),
        "width": inputs.width,
        "height": inputs.height,
        "rows": rows,
        "beaten_by": [f"{row['knob']} {row['value']}" for row in rows[1:] if beats(row, rows[0])],
    }


def beats(row: Row, other: Row) -> bool:
    """Whether `row` has no larger error than the default, whatever it is held against, in clearly less time:
    three rounds of four were faster."""
    no_worse = all(
        error(row["errors"][oracle]) <= error(other["errors"][oracle])
        for oracle in ORACLES
        for error in ERRORS.values()
    )
    return no_worse and row["ratio_quartiles"][1] < 1


def measure_by_threads(inputs: RasterInputs, repeats: int) -> list[Row]:
    """Seconds with each number of threads, and the largest difference to one thread in any output."""
    case = TunedPass(inputs, Knobs())
    rows = measure_threads({"default": case}, repeats)
    before = hqgs.get_num_threads()
    try:
        hqgs.set_num_threads(1)
        one = case.outputs()
        for row in rows:
            hqgs.set_num_threads(row["threads"])
            several = case.outputs()
            row["difference"] = max(float((several[name] - one[name]).abs().max()) for name in one)
            row["same_bits"] = all(torch.equal(several[name], one[name]) for name in one)
    finally:
        hqgs.set_num_threads(before)
    return rows


def table(result: dict[str, Any]) -> str:
    """One row for each case; the errors against the exact result, then against the definition in float64."""
    head = [
        "knob", "value", "ms", "time / default", "quartiles", "blocks / default",
        "image RMS, exact", "max", "PSNR (dB)", "gradients, exact", "1 - cosine",
        "image RMS, defined", "gradients, defined",
    ]  # fmt: skip
    first = result["rows"][0]
    body = []
    for row in result["rows"]:
        exact, defined = row["errors"]["exact"], row["errors"]["defined"]
        psnr, all_ = exact["image"]["psnr"], exact["gradients"]["all"]
        body.append(
            [
                row["knob"],
                row["value"],
                f"{1000 * row['seconds']:.1f}",
                f"{row['ratio']:.3f}",
                " to ".join(f"{q:.3f}" for q in row["ratio_quartiles"]),
                f"{row['blocks'] / max(first['blocks'], 1):.2f}",
                f"{exact['image']['rms']:.1e}",
                f"{exact['image']['max']:.1e}",
                "" if psnr is None else f"{psnr:.1f}",
                _number(all_["relative"]),
                "" if all_["cosine"] is None else f"{1 - all_['cosine']:.1e}",
                f"{defined['image']['rms']:.1e}",
                _number(defined["gradients"]["all"]["relative"]),
            ]
        )
    title = (
        f"{result['inputs']}: {result['gaussians']:,} Gaussians, {result['width']} x {result['height']}, "
        "forward and backward"
    )
    return markdown_table(title, head, body)


def gradient_table(result: dict[str, Any]) -> str:
    """The relative error of each input's gradient against the exact result."""
    names = list(result["rows"][0]["errors"]["exact"]["gradients"])
    body = [
        [
            row["knob"],
            row["value"],
            *(_number(row["errors"]["exact"]["gradients"][name]["relative"]) for name in names),
        ]
        for row in result["rows"]
    ]
    return markdown_table(
        f"{result['inputs']}: relative error of the gradients against the exact result",
        ["knob", "value", *names],
        body,
    )


def threads_table(rows: list[Row], name: str) -> str:
    body = [
        [str(r["threads"]), f"{1000 * r['seconds']:.1f}", f"{r['speedup']:.2f}", f"{r['difference']:g}"]
        for r in rows
    ]
    return markdown_table(
        f"{name}: threads", ["threads", "ms", "speed-up", "largest difference to 1 thread"], body
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def chart(result: dict[str, Any]) -> Figure:
    """Error against time on log axes: rows are what is held against, columns are image and gradients."""
    figure = Figure(figsize=(11, 8), dpi=150, layout="constrained")
    grid = figure.subplots(len(ORACLES), len(ERRORS), squeeze=False, sharex=True)
    labels = {"image": "image RMS error", "gradients": "relative error of the gradients"}
    titles = {"exact": "against the exact result", "defined": "against the definition in float64"}
    for line, oracle in zip(grid, ORACLES, strict=True):
        for axes, (what, error) in zip(line, ERRORS.items(), strict=True):
            points = [
                (1000 * row["seconds"], error(row["errors"][oracle]), row["knob"], row["value"])
                for row in result["rows"]
            ]
            _panel(axes, [p for p in points if p[1] > 0])  # what has no error has no place on a log axis
            axes.set_title(f"{labels[what]}, {titles[oracle]}", fontsize=9, loc="left")
            axes.set_xlabel("forward and backward (ms)")
    handles, names = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    figure.suptitle(f"{result['inputs']}, {result['gaussians']:,} Gaussians", fontsize=10)
    return figure


def _panel(axes: Axes, points: list[tuple[float, float, str, str]]) -> None:
    times, errors = [p[0] for p in points], [p[1] for p in points]
    front = pareto_front(times, errors)
    axes.plot(
        [times[k] for k in front],
        [errors[k] for k in front],
        color="#888888",
        lw=1.2,
        drawstyle="steps-post",
        label="no other one is better in both",
    )
    for k, knob in enumerate(dict.fromkeys(case[0] for case in CASES)):
        own = [(x, y, value) for x, y, name, value in points if name == knob]
        first = knob == "default"
        axes.plot(
            [p[0] for p in own], [p[1] for p in own], linestyle="", label=knob, color=f"C{k}",
            marker="*" if first else "o", markersize=13 if first else 5, zorder=4 if first else 3,
        )  # fmt: skip
        for x, y, value in own:
            axes.annotate(value, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=6, rotation=40)
    axes.set(xscale="log", yscale="log")
    axes.grid(color="#dddddd", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)


def run(args: argparse.Namespace) -> Report:
    """Measure every case on the clouds and on the trained Gaussians."""
    config = replace(QUICK if args.quick else AccuracyConfig(), seed=args.seed)
    if args.repeats is not None:
        if args.repeats < 1:
            raise ValueError(f"repeats is {args.repeats}, wanted at least 1")
        config = replace(config, repeats=args.repeats)
    report = Report(settings=asdict(config))
    inputs = {f"cloud of {n:,}": make_inputs(n, *config.size, config.seed) for n in config.gaussians}
    print("bench accuracy: training the built-in scene", file=sys.stderr)
    inputs["built-in scene, trained"] = trained_inputs(
        config.size,
        config.trained_views,
        config.trained_steps,
        config.trained_gaussians,
        config.seed,
        args.out / "scene",
    )
    results = []
    for name, x in inputs.items():
        print(f"bench accuracy: {name}", file=sys.stderr)
        results.append(measure(name, x, config.repeats))
        report.tables += [table(results[-1]), gradient_table(results[-1])]
    report.results["inputs"] = results
    name, largest = max(inputs.items(), key=lambda item: len(item[1]))
    if len(thread_counts()) > 1:
        report.results["threads"] = measure_by_threads(largest, config.repeats)
        report.tables.append(threads_table(report.results["threads"], name))
    else:
        report.left_out.append({"what": "threads", "why": "there is one thread"})
    why = "it only groups the work: blocks of 4 x 4 pixels inside exact spans decide what is computed"
    report.left_out.append({"what": "tile size", "why": why})
    for result in results:
        beaten = ", ".join(result["beaten_by"]) or "nothing"
        report.tables.append(f"{result['inputs']}: better than the default in error and time: {beaten}.")
        report.figures[result["inputs"].replace(" ", "_").replace(",", "")] = chart(result)
    return report


def add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--repeats", type=int, metavar="N", help="rounds of each measurement (15, with --quick 2)")
    add("--seed", type=int, default=AccuracyConfig.seed, metavar="S", help="of the Gaussians (%(default)s)")


BENCHMARK = Benchmark("error of the rasterizer against its run time, knob by knob", add_options, run)
