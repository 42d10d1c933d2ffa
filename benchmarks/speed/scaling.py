"""How the time of a forward and backward pass grows with the Gaussians and with the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import charts
from benchmarks.charts import BLUE, LEGEND, ORANGE, panels
from benchmarks.speed.inputs import fitted, make_inputs
from benchmarks.speed.rasterizer import RasterPass, warmed
from benchmarks.speed.timing import exponent, interleaved, whole

Size = tuple[int, int]  # width, height
TARGET = 1.05  # the largest exponent that is good


def measure_scaling(
    sizes: Sequence[int], image: Size, images: Sequence[Size], gaussians: int, repeats: int, seed: int
) -> dict[str, Any]:
    """Time against the number of Gaussians in one image, and of `gaussians` against the size of the image.

    The overlap per pixel is the same everywhere.
    """
    cloud = make_inputs(max(sizes), *image, seed)  # the smaller ones share its memory
    unit = {n: fitted(cloud, n, *image) for n in sizes}
    by_size = _curve(sizes, [RasterPass(x) for x in unit.values()], repeats)
    del cloud, unit
    cloud = make_inputs(gaussians, *images[0], seed)
    passes = [RasterPass(fitted(cloud, gaussians, *size)) for size in images]
    by_pixels = _curve([width * height for width, height in images], passes, repeats)
    return {
        "gaussians": {"width": image[0], "height": image[1], **by_size},
        "pixels": {"gaussians": gaussians, **by_pixels},
        "target_exponent": TARGET,
    }


def _curve(x: Sequence[int], passes: Sequence[RasterPass], repeats: int) -> dict[str, Any]:
    measured = interleaved({str(v): warmed(p) for v, p in zip(x, passes, strict=True)}, repeats)
    rows = [whole(rounds) for rounds in measured.values()]
    curve = {name: [row[name] for row in rows] for name in ("seconds", "seconds_quartiles")}
    ends = pairwise(zip(x, curve["seconds"], strict=True))
    steepest = max(exponent(*zip(*two, strict=True)) for two in ends)  # between two neighbours
    return {"x": list(x), **curve, "exponent": exponent(x, curve["seconds"]), "steepest": steepest}


def scaling_chart(scaling: dict[str, Any]) -> Figure:
    """Two panels: time against Gaussians and against megapixels, with the fitted power."""
    figure, (left, right) = panels(9, 4, 1, 2, sharey=True)
    curve = scaling["gaussians"]
    _panel(left, curve, 1, "Gaussians", f"{curve['width']} x {curve['height']} pixels", BLUE)
    left.set_ylabel("forward and backward (s)")
    curve = scaling["pixels"]
    _panel(right, curve, 1e6, "megapixels", f"{curve['gaussians']} Gaussians", ORANGE)
    return figure


def _panel(axes: Axes, curve: dict[str, Any], unit: float, label: str, title: str, color: str) -> None:
    x, seconds = np.array(curve["x"]) / unit, np.array(curve["seconds"])
    low, high = np.array(curve["seconds_quartiles"]).T
    axes.errorbar(x, seconds, [seconds - low, high - seconds], color=color, marker="o", markersize=4, lw=1.6)
    center = np.exp(np.log(seconds).mean()) * (x / np.exp(np.log(x).mean())) ** curve["exponent"]
    axes.plot(x, center, color="#888888", linestyle="--", linewidth=1, label=f"power {curve['exponent']:.2f}")
    axes.set(xscale="log", yscale="log", xlabel=label)
    charts.title(axes, title)
    axes.legend(**LEGEND)
