"""The benchmark `accuracy`: the error against the run time of every knob of the rasterizer.

A knob trades accuracy for time. It is set for one pass, and what it is by default is the product's.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.command import TIMED, Benchmark, sizes_of
from benchmarks.measure import Training
from benchmarks.pages.figures import listed
from benchmarks.pages.sections import unbeaten_default
from benchmarks.patches import Knobs, tuned
from benchmarks.protocol import Row, read_toml
from benchmarks.rows import Table, facts
from benchmarks.scenes.room.scene import embedded_scene
from benchmarks.speed.inputs import LEAVES, RasterInputs, make_inputs
from benchmarks.speed.rasterizer import RasterPass
from benchmarks.speed.timing import interleaved, quartiles
from hqgs.base.threads import one_torch_thread
from hqgs.base.typed import build
from hqgs.model.render import render_view
from hqgs.scene.scene import Scene
from hqgs.training.methods.base import photo_tensors
from hqgs.training.methods.photometric import photometric_loss

FILE = Path(__file__).with_suffix(".toml")
DATA = read_toml(FILE)
SHOWN = {
    "inputs": ("inputs", ""),
    "knob": ("knob", ""),
    "value": ("value", ""),
    "seconds": ("ms", "ms"),
    "ratio": ("time / default", ".3f"),
    "blocks_ratio": ("blocks / default", ".2f"),
    "image_exact": ("image RMS, exact", ".1e"),
    "gradients_exact": ("gradients, exact", ".1e"),
    "image_defined": ("image RMS, defined", ".1e"),
    "gradients_defined": ("gradients, defined", ".1e"),
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


def measure(name: str, inputs: RasterInputs, repeats: int) -> list[dict[str, Any]]:
    """A line for every case on the same numbers: errors and seconds; those of a round are taken in turn."""
    passes = {case: TunedPass(inputs, knobs) for case, knobs in CASES.items()}
    oracles = {oracle: TunedPass(inputs, knobs).outputs() for oracle, knobs in ORACLES.items()}
    rows: list[dict[str, Any]] = []
    blocks = 0
    for (knob, value), case in passes.items():
        outputs = case.outputs()
        row = {"inputs": name, "knob": knob, "value": value, "gaussians": len(inputs)}
        row |= {"width": inputs.width, "height": inputs.height}
        for oracle, exact in oracles.items():
            errors = errors_against(outputs, exact)
            row |= {f"image_{oracle}": errors["rms"], f"image_{oracle}_max": errors["max"]}
            row[f"gradients_{oracle}"] = errors["gradients"]
        blocks = blocks or case.work[1]
        rows.append(row | {"tile_pairs": case.work[0], "blocks_ratio": case.work[1] / max(blocks, 1)})
    measured = interleaved(passes, repeats)
    for row, rounds in zip(rows, measured.values(), strict=True):
        ratios = rounds["total"] / measured["default", ""]["total"]  # in the same round
        low, high = quartiles(ratios)
        row |= {"seconds": rounds["total"].median(), "ratio": ratios.median()}
        row |= {"ratio_low": low, "ratio_high": high} | facts()
    return rows


def errors_against(outputs: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, float]:
    """RMS and largest error of the image, and |g - exact| / |exact| of all gradients as one vector.

    Both hold "image" and the gradients by name, float64.
    """
    (image, *found), (wanted, *truth) = (
        [side[name].flatten() for name in exact] for side in (outputs, exact)
    )
    difference, gradients = (image - wanted).abs(), torch.cat(truth)
    return {
        "rms": float(difference.square().mean().sqrt()),
        "max": float(difference.max()),
        "gradients": float((torch.cat(found) - gradients).norm() / gradients.norm()),
    }


def trained_inputs(scene: Scene, steps: int, most: int, seed: int) -> RasterInputs:
    """At most `most` Gaussians after `steps` of 3DGS; `v_image` is the gradient of the loss there."""
    config = Row("3dgs").train_config(seed, steps, {"densify": {"max_gaussians": most}, "sh_interval": 1})
    done = Training(scene, config)
    done.steps(steps)
    g, view = done.trainer.gaussians.detached(), done.trainer.scene.train[0]
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


def run(args: argparse.Namespace) -> list[str]:
    """Measure every case on the clouds and on the trained Gaussians."""
    sizes = sizes_of(DATA, args)
    table = Table(args.out / "accuracy.csv")
    inputs = {f"cloud of {n:,}": make_inputs(n, *sizes["size"], seed=args.seed) for n in sizes["gaussians"]}
    print("accuracy: training the built-in scene", file=sys.stderr)
    scene = embedded_scene(args.out / "scene", *sizes["size"], num_views=sizes["trained_views"])
    inputs["built-in scene, trained"] = trained_inputs(
        scene, sizes["trained_steps"], sizes["trained_gaussians"], args.seed
    )
    rows: list[dict[str, str]] = []
    for name, x in inputs.items():
        print(f"accuracy: {name}", file=sys.stderr)
        rows += table.put(measure(name, x, sizes["repeats"]))
    runs = table.frame(rows)
    return [listed(runs, SHOWN), unbeaten_default(runs)]


HELP = "error of the rasterizer against its run time, knob by knob"
BENCHMARK = Benchmark(HELP, run, options=TIMED)
