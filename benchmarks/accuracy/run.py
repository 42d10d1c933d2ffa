"""The benchmark `accuracy`: the error against the run time of every knob of the rasterizer."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.accuracy.knobs import CASES, FILE, ORACLES, Knobs, TunedPass
from benchmarks.charts import LEGEND, color, panels, unbeaten
from benchmarks.data import read_toml
from benchmarks.measure import Training
from benchmarks.output import Benchmark, Report, repeats_and_seed, span, table, with_repeats
from benchmarks.protocol import Row
from benchmarks.speed.inputs import RasterInputs, make_inputs
from benchmarks.speed.rasterizer import measure_threads, thread_counts
from benchmarks.speed.timing import interleaved, quartiles, using_threads, whole
from hqgs.base.threads import one_torch_thread
from hqgs.model.render import render_view
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.scene import Scene
from hqgs.training.methods.base import photo_tensors
from hqgs.training.methods.photometric import photometric_loss

DATA = read_toml(FILE)
COLUMNS = DATA["columns"]
IMAGE = "image"
Errors = dict[str, Any]  # of a row against an oracle
ERRORS: dict[str, Callable[[Errors], float]] = {  # what the panels show
    "image": lambda errors: errors["image"]["rms"],
    "gradients": lambda errors: errors["gradients"]["all"]["relative"],
}


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
        ratios = rounds["total"] / measured[0]["total"]  # to the default, in the same round
        row = {"knob": knob, "value": value, "settings": asdict(knobs), **whole(rounds), "errors": errors}
        row |= {"ratio": ratios.median(), "ratio_quartiles": quartiles(ratios)}
        rows.append(row | {"tile_pairs": case.work[0], "blocks": case.work[1]})
    beaten = [f"{row['knob']} {row['value']}" for row in rows[1:] if beats(row, rows[0])]
    size = {"inputs": name, "gaussians": len(inputs), "width": inputs.width, "height": inputs.height}
    return size | {"rows": rows, "beaten_by": beaten}


def beats(row: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether `row` has no larger error than the default, whatever it is held against, in clearly less time:
    three rounds of four were faster."""
    no_worse = all(
        error(row["errors"][oracle]) <= error(other["errors"][oracle])
        for oracle in ORACLES
        for error in ERRORS.values()
    )
    return no_worse and row["ratio_quartiles"][1] < 1


def measure_by_threads(inputs: RasterInputs, repeats: int) -> list[dict[str, Any]]:
    """Seconds with each number of threads, and the largest difference to one thread in any output."""
    case = TunedPass(inputs, Knobs())
    rows = measure_threads({"default": case}, repeats)
    with using_threads(1):
        one = case.outputs()
    for row in rows:
        with using_threads(row["threads"]):
            several = case.outputs()
        row["difference"] = max(float((several[name] - one[name]).abs().max()) for name in one)
        row["same_bits"] = all(torch.equal(several[name], one[name]) for name in one)
    return rows


def errors_table(result: dict[str, Any]) -> str:
    """One row for each case; the errors against the exact result, then against the definition in float64."""
    first, lines = result["rows"][0], []
    for row in result["rows"]:
        exact, defined = row["errors"]["exact"], row["errors"]["defined"]
        every = exact["gradients"]["all"]
        line = row | exact["image"] | {"quartiles": span(row["ratio_quartiles"], ".3f")}
        line |= {"more_blocks": row["blocks"] / max(first["blocks"], 1), "gradients": every["relative"]}
        line |= {"turn": None if every["cosine"] is None else 1 - every["cosine"]}
        lines.append(line | {f"{name}_defined": error(defined) for name, error in ERRORS.items()})
    size = f"{result['gaussians']:,} Gaussians, {result['width']} x {result['height']}"
    return table(f"{result['inputs']}: {size}, forward and backward", lines, COLUMNS["errors"])


def chart(result: dict[str, Any]) -> Figure:
    """Error against time on log axes: rows are what is held against, columns are image and gradients."""
    figure, grid = panels(11, 8, len(ORACLES), len(ERRORS), sharex=True)
    labels = {"image": "image RMS error", "gradients": "relative error of the gradients"}
    titles = {"exact": "against the exact result", "defined": "against the definition in float64"}
    for axes, (oracle, what) in zip(grid, ((o, e) for o in ORACLES for e in ERRORS), strict=True):
        points = [
            (1000 * row["seconds"], ERRORS[what](row["errors"][oracle]), row["knob"], row["value"])
            for row in result["rows"]
        ]
        _panel(axes, [p for p in points if p[1] > 0])  # what has no error has no place on a log axis
        axes.set_title(f"{labels[what]}, {titles[oracle]}", fontsize=9, loc="left")
        axes.set_xlabel("forward and backward (ms)")
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=5, **LEGEND)
    figure.suptitle(f"{result['inputs']}, {result['gaussians']:,} Gaussians", fontsize=10)
    return figure


def _panel(axes: Axes, points: list[tuple[float, float, str, str]]) -> None:
    times, errors = zip(*(points[k][:2] for k in unbeaten([p[:2] for p in points])), strict=True)
    label = "no other one is better in both"
    axes.plot(times, errors, color="#888888", lw=1.2, drawstyle="steps-post", label=label)
    for k, knob in enumerate(dict.fromkeys(case[0] for case in CASES)):
        own = [(x, y, value) for x, y, name, value in points if name == knob]
        first = knob == "default"
        axes.plot(
            [p[0] for p in own], [p[1] for p in own], linestyle="", label=knob, color=color(k),
            marker="*" if first else "o", markersize=13 if first else 5, zorder=4 if first else 3,
        )  # fmt: skip
        for x, y, value in own:
            axes.annotate(value, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=6, rotation=40)
    axes.set(xscale="log", yscale="log")


def errors_against(outputs: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, Any]:
    """Image and gradients against `exact`; both hold "image" and the gradients by name, float64.

    The image: largest and root-mean-square error, and PSNR in dB where white is 1 (None: no error). Each
    gradient, and "all" of them as one vector: |g - exact| / |exact|, and the cosine of the angle between the
    two (None: one of them is 0).
    """
    difference = outputs[IMAGE] - exact[IMAGE]
    rms = float(difference.square().mean().sqrt())
    names = [name for name in exact if name != IMAGE]
    gradients = {name: _direction(outputs[name].flatten(), exact[name].flatten()) for name in names}
    both = [torch.cat([side[name].flatten() for name in names]) for side in (outputs, exact)]
    psnr = -20 * math.log10(rms) if rms > 0 else None
    return {
        IMAGE: {"max": float(difference.abs().max()), "rms": rms, "psnr": psnr},
        "gradients": gradients | {"all": _direction(*both)},
    }


def _direction(found: Tensor, exact: Tensor) -> dict[str, float | None]:
    length, other = float(exact.norm()), float(found.norm())
    if length == 0 or other == 0:
        return {"relative": None, "cosine": None}
    cosine = float(found @ exact) / (length * other)
    return {"relative": float((found - exact).norm()) / length, "cosine": min(1.0, cosine)}


def trained_inputs(scene: Scene, steps: int, most: int, seed: int) -> RasterInputs:
    """At most `most` Gaussians after `steps` of 3DGS; `v_image` is the gradient of the loss there."""
    config = Row("3dgs").train_config(seed, steps, {"densify": {"max_gaussians": most}, "sh_interval": 1})
    done = Training(scene, config)
    done.steps(steps)
    g, view = done.trainer.gaussians.detached(), scene.train[0]
    with one_torch_thread():
        image, _ = render_view(g, view.camera, 3, config.background)
        image.requires_grad_()
        photo, mask = photo_tensors(view)
        photometric_loss(image, photo, mask).backward()
    assert image.grad is not None
    return RasterInputs(
        means=g.means.numpy(),
        quats=g.quats.numpy(),
        scales=g.activated_scales().numpy(),
        opacities=g.activated_opacities().numpy(),
        sh=torch.cat([g.sh0, g.shN], dim=1).numpy(),
        v_image=image.grad.numpy(),
        viewmat=view.camera.viewmat,
        K=view.camera.K,
        background=np.array(config.background, np.float32),
    )


def run(args: argparse.Namespace) -> Report:
    """Measure every case on the clouds and on the trained Gaussians."""
    sizes = with_repeats(DATA["quick" if args.quick else "full"], args)
    report = Report(settings=sizes)
    inputs = {f"cloud of {n:,}": make_inputs(n, *sizes["size"], seed=args.seed) for n in sizes["gaussians"]}
    print("accuracy: training the built-in scene", file=sys.stderr)
    scene = embedded_scene(args.out / "scene", *sizes["size"], num_views=sizes["trained_views"])
    inputs["built-in scene, trained"] = trained_inputs(
        scene, sizes["trained_steps"], sizes["trained_gaussians"], args.seed
    )
    results = report.results["inputs"] = []
    for name, x in inputs.items():
        print(f"accuracy: {name}", file=sys.stderr)
        results.append(measure(name, x, sizes["repeats"]))
        report.tables.append(errors_table(results[-1]))
    name, largest = max(inputs.items(), key=lambda item: len(item[1]))
    if len(thread_counts()) > 1:
        rows = report.results["threads"] = measure_by_threads(largest, sizes["repeats"])
        report.tables.append(table(f"{name}: threads", rows, COLUMNS["threads"]))
    else:
        report.leave_out("threads", "there is one thread")
    why = "it only groups the work: blocks of 4 x 4 pixels inside exact spans decide what is computed"
    report.leave_out("tile size", why)
    for result in results:
        beaten = ", ".join(result["beaten_by"]) or "nothing"
        report.tables.append(f"{result['inputs']}: better than the default in error and time: {beaten}.")
        report.figures[result["inputs"].replace(" ", "_").replace(",", "")] = chart(result)
    return report


HELP = "error of the rasterizer against its run time, knob by knob"
BENCHMARK = Benchmark(HELP, run, options=repeats_and_seed(DATA))
