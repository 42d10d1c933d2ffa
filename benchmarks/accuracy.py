"""The benchmark `accuracy`: the error against the run time of every knob of the rasterizer.

A knob trades accuracy for time. It is set for one pass, and what it is by default is the product's.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.measure import Training
from benchmarks.output import LEGEND, TIMED, Benchmark, Report, color, panels, sizes_of, table, unbeaten
from benchmarks.patches import Knobs, tuned
from benchmarks.protocol import Row, read_toml
from benchmarks.speed.inputs import LEAVES, RasterInputs, make_inputs
from benchmarks.speed.rasterizer import RasterPass
from benchmarks.speed.timing import interleaved, quartiles, whole
from hqgs.base.threads import one_torch_thread
from hqgs.base.typed import build
from hqgs.model.render import render_view
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.scene import Scene
from hqgs.training.methods.base import photo_tensors
from hqgs.training.methods.photometric import photometric_loss

FILE = Path(__file__).with_suffix(".toml")
DATA = read_toml(FILE)
Errors = dict[str, Any]  # of a row against an oracle
ERRORS: dict[str, Callable[[Errors], float]] = {  # what the panels show
    "image RMS error": lambda errors: errors["image"]["rms"],
    "relative error of the gradients": lambda errors: errors["gradients"]["all"]["relative"],
}


# By knob and value; the first is what is measured against.
CASES: dict[tuple[str, str], Knobs] = {
    (knob, value): build(Knobs, settings, f"{FILE.name}, {knob} {value}")
    for knob, values in DATA["cases"].items()
    for value, settings in values.items()
}
ORACLES = {  # the definition of docs/conventions.md without float32's roundings, and without its cutoffs
    "exact": CASES["cutoffs", "none, float64"],
    "defined": CASES["dtype", "float64"],
}


class TunedPass(RasterPass):
    """A pass with other settings than the default."""

    def __init__(self, inputs: RasterInputs, knobs: Knobs) -> None:
        super().__init__(inputs, dtype=getattr(torch, knobs.dtype))
        self.knobs = knobs

    def run(self) -> Tensor:
        with tuned(self.knobs):
            return super().run()

    def outputs(self) -> dict[str, Tensor]:
        """The image, and the gradient of each input by its name, all in float64."""
        image = self.run()
        grads = {n: leaf.grad for n, leaf in zip(LEAVES, self.leaves, strict=True) if leaf.grad is not None}
        self.clear()
        return {name: tensor.double() for name, tensor in ({"image": image} | grads).items()}


def measure(name: str, inputs: RasterInputs, repeats: int) -> dict[str, Any]:
    """Errors and seconds of every case on the same numbers; the seconds of a round are taken in turn."""
    passes = {case: TunedPass(inputs, knobs) for case, knobs in CASES.items()}
    oracles = {oracle: TunedPass(inputs, knobs).outputs() for oracle, knobs in ORACLES.items()}
    rows: list[dict[str, Any]] = []
    for (knob, value), case in passes.items():
        outputs = case.outputs()
        errors = {oracle: errors_against(outputs, exact) for oracle, exact in oracles.items()}
        work = {"tile_pairs": case.work[0], "blocks": case.work[1]}
        work |= {"more_blocks": case.work[1] / max(rows[0]["blocks"], 1) if rows else 1.0}
        rows.append({"knob": knob, "value": value, "settings": asdict(case.knobs), "errors": errors} | work)
    measured = interleaved(passes, repeats)
    for row, rounds in zip(rows, measured.values(), strict=True):
        ratios = rounds["total"] / measured["default", ""]["total"]  # in the same round
        row |= {**whole(rounds), "ratio": ratios.median(), "ratio_quartiles": quartiles(ratios)}
    beaten = [f"{row['knob']} {row['value']}" for row in rows if beats(row, rows[0])]
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


def errors_table(result: dict[str, Any]) -> str:
    """One row for each case; the errors against the exact result, then against the definition in float64."""
    cosines = [row["errors"]["exact"]["gradients"]["all"]["cosine"] for row in result["rows"]]
    turns = [None if cosine is None else 1 - cosine for cosine in cosines]
    lines = [row | {"turn": turn} for row, turn in zip(result["rows"], turns, strict=True)]
    size = f"{result['gaussians']:,} Gaussians, {result['width']} x {result['height']}"
    return table(f"{result['inputs']}: {size}, forward and backward", lines, DATA["columns"])


def chart(result: dict[str, Any]) -> Figure:
    """Error against time on log axes: rows are what is held against, columns are image and gradients."""
    figure, grid = panels(11, 8, len(ORACLES), len(ERRORS), sharex=True)
    titles = {"exact": "against the exact result", "defined": "against the definition in float64"}
    shown = ((oracle, what) for oracle in ORACLES for what in ERRORS)
    for axes, (oracle, what) in zip(grid, shown, strict=True):
        points = [
            (1000 * row["seconds"], ERRORS[what](row["errors"][oracle]), row["knob"], row["value"])
            for row in result["rows"]
        ]
        _panel(axes, [p for p in points if p[1] > 0])  # what has no error has no place on a log axis
        axes.set_title(f"{what}, {titles[oracle]}", fontsize=9, loc="left")
        axes.set_xlabel("forward and backward (ms)")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, **LEGEND)
    figure.suptitle(f"{result['inputs']}, {result['gaussians']:,} Gaussians", fontsize=10)
    return figure


def _panel(axes: Axes, points: list[tuple[float, float, str, str]]) -> None:
    times, errors = zip(*(points[k][:2] for k in unbeaten([p[:2] for p in points])), strict=True)
    label = "no other one is better in both"
    axes.plot(times, errors, color="#888888", lw=1.2, drawstyle="steps-post", label=label)
    for k, knob in enumerate(dict.fromkeys(knob for knob, _ in CASES)):
        own = [(x, y, value) for x, y, name, value in points if name == knob]
        star: dict[str, Any] = {"marker": "*", "markersize": 13, "zorder": 4}
        dot: dict[str, Any] = {"marker": "o", "markersize": 5, "zorder": 3}
        look = star if knob == "default" else dot
        axes.plot([p[0] for p in own], [p[1] for p in own], ls="", label=knob, color=color(k), **look)
        for x, y, value in own:
            axes.annotate(value, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=6, rotation=40)
    axes.set(xscale="log", yscale="log")


def errors_against(outputs: dict[str, Tensor], exact: dict[str, Tensor]) -> Errors:
    """Image and gradients against `exact`; both hold "image" and the gradients by name, float64.

    The image: largest and root-mean-square error, and PSNR in dB where white is 1 (None: no error). Each
    gradient, and "all" of them as one vector: |g - exact| / |exact|, and the cosine of the angle between the
    two (None: one of them is 0).
    """
    (image, *found), (wanted, *truth) = (
        [side[name].flatten() for name in exact] for side in (outputs, exact)
    )
    difference = image - wanted
    rms = float(difference.square().mean().sqrt())
    psnr = -20 * math.log10(rms) if rms > 0 else None
    pairs = zip([*found, torch.cat(found)], [*truth, torch.cat(truth)], strict=True)
    return {
        "image": {"max": float(difference.abs().max()), "rms": rms, "psnr": psnr},
        "gradients": dict(zip([*list(exact)[1:], "all"], (_direction(*pair) for pair in pairs), strict=True)),
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
        photometric_loss(image, *photo_tensors(view)).backward()
    assert image.grad is not None
    scales, opacities, sh = g.activated_scales(), g.activated_opacities(), torch.cat([g.sh0, g.shN], dim=1)
    leaves = (tensor.numpy() for tensor in (g.means, g.quats, scales, opacities, sh))
    return RasterInputs(
        **dict(zip(LEAVES, leaves, strict=True)),
        v_image=image.grad.numpy(),
        viewmat=view.camera.viewmat,
        K=view.camera.K,
        background=np.array(config.background, np.float32),
    )


def run(args: argparse.Namespace) -> Report:
    """Measure every case on the clouds and on the trained Gaussians."""
    sizes = sizes_of(DATA, args)
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
    for result in results:
        beaten = ", ".join(result["beaten_by"]) or "nothing"
        report.tables.append(f"{result['inputs']}: better than the default in error and time: {beaten}.")
        report.figures[result["inputs"].replace(" ", "_").replace(",", "")] = chart(result)
    return report


HELP = "error of the rasterizer against its run time, knob by knob"
BENCHMARK = Benchmark(HELP, run, options=TIMED)
