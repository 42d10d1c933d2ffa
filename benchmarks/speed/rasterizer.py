"""Forward and backward of the rasterizer, stage by stage, against the limit of its arithmetic.

The limit is a lane of an AVX-512 core that does nothing but blend, with all lanes in use and all data in
cache (measured with a probe of the arithmetic).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from matplotlib.figure import Figure

import hqgs
from benchmarks.output import LEGEND, color, panels, title
from benchmarks.patches import COMPOSITE, CRATE
from benchmarks.speed.inputs import LEAVES, RasterInputs, fitted, make_inputs
from benchmarks.speed.timing import (
    Seconds,
    StageClock,
    exponent,
    interleaved,
    median_ratio,
    using_threads,
    whole,
)
from hqgs.base.threads import one_torch_thread

STAGES = list(CRATE.values())
Size = tuple[int, int]  # width, height
TARGET = 1.05  # the largest exponent that is good
AGAINST = {"gaussians": "Gaussians", "pixels": "pixels"}  # what the time grows with
BIN = "bin"  # the part of "bin and composite" before the first pixel
BLOCK_PIXELS = 16  # lanes of a block of 4 x 4 pixels
LIMIT_NS = 0.65 + 1.05  # of one core, for a pair that blends: forward, backward


class RasterPass:
    """`hqgs.rasterization` with harmonics of degree 3 and its backward pass, timed; all gradients but the
    camera's. The same numbers in any `dtype`."""

    def __init__(self, inputs: RasterInputs, dtype: torch.dtype = torch.float32) -> None:
        tensors = (torch.from_numpy(getattr(inputs, name)) for name in LEAVES)
        self.leaves = [tensor.to(dtype).requires_grad_() for tensor in tensors]
        viewmat, K = (torch.from_numpy(m[None]).float() for m in (inputs.viewmat, inputs.K))
        self.arguments: dict[str, Any] = dict(zip((*LEAVES[:4], "colors"), self.leaves, strict=True))
        self.arguments |= {"viewmats": viewmat, "Ks": K, "width": inputs.width, "height": inputs.height}
        self.arguments |= {"backgrounds": torch.from_numpy(inputs.background[None]).to(dtype), "sh_degree": 3}
        self.v_image = torch.from_numpy(inputs.v_image[None]).to(dtype)
        self.work = (0, 0, 0)  # of the last pass: pairs, blocks, blocks with a change
        self.blended = 0  # (Gaussian, pixel) pairs of the last pass that was timed

    def run(self) -> torch.Tensor:
        """One pass; returns the image [1, H, W, 3], the gradients are in the leaves."""
        image, _, meta = hqgs.rasterization(**self.arguments)
        image.backward(self.v_image)
        self.work = meta["work"]
        return image.detach()

    def __call__(self) -> Seconds:
        clock, composites = StageClock(), list[Any]()
        with one_torch_thread(), clock.watching(CRATE), _keeping(composites):
            seconds = clock.seconds(self.run, STAGES)
        self.clear()
        self.blended = sum(composite.blended for composite in composites)
        return seconds | {BIN: sum(composite.bin_seconds for composite in composites)}

    def clear(self) -> None:
        """Free the gradients, so that the many cases of a benchmark fit into memory together."""
        for leaf in self.leaves:
            leaf.grad = None


@contextmanager
def _keeping(composites: list[Any]) -> Iterator[None]:
    """Add to the list what the crate counts and times itself in each composite."""
    forward = getattr(*COMPOSITE)

    def call(*args: Any) -> Any:
        out = forward(*args)
        composites.append(out[0])
        return out

    with patch.object(*COMPOSITE, call):
        yield


def warmed(case: Callable[[], Seconds]) -> Callable[[], Seconds]:
    """The second of two passes in a row: as in training, its memory is what the one before gave back."""

    def call() -> Seconds:
        case()
        return case()

    return call


def count_work(case: RasterPass, pixels: int) -> dict[str, Any]:
    """What the crate counted in the last pass: (Gaussian, pixel) pairs that changed one of so many pixels,
    (Gaussian, tile) pairs, (Gaussian, block) pairs that each pass evaluates, those that changed a pixel."""
    tile_pairs, blocks, changed_blocks = case.work
    return {
        "blended_per_pixel": case.blended / pixels,
        "blended_pairs": case.blended,
        "tile_pairs": tile_pairs,
        "blocks": blocks,
        "changed_blocks": changed_blocks,
        "changed_share": changed_blocks / blocks,
        "lane_use": case.blended / (BLOCK_PIXELS * blocks),
        "limit_core_seconds": case.blended * LIMIT_NS * 1e-9,
    }


def measure(inputs: Sequence[RasterInputs], repeats: int) -> list[dict[str, Any]]:
    """Time and work of each of the inputs."""
    passes = [RasterPass(x) for x in inputs]
    measured = interleaved({k: warmed(case) for k, case in enumerate(passes)}, repeats)
    rows = []
    for x, case, rounds in zip(inputs, passes, measured.values(), strict=True):
        work = count_work(case, x.width * x.height)
        limit = work["limit_core_seconds"] / hqgs.get_num_threads()
        compositing = (rounds["bin and composite"] - rounds[BIN] + rounds["composite backward"]).median()
        rows.append(
            {"gaussians": len(x), "width": x.width, "height": x.height, **whole(rounds)}
            | {
                "stages": rounds[[*STAGES, "rest"]].median().to_dict(),
                "limit_seconds": limit,
                "times_limit": rounds["total"].median() / limit,
                "bin_seconds": rounds[BIN].median(),
                "compositing_seconds": compositing,
                "compositing_times_limit": compositing / limit,
                "work": work,
                "rounds": rounds.to_dict("records"),
            }
        )
    return rows


def measure_threads(cases: dict[str, Callable[[], Seconds]], repeats: int) -> list[dict[str, Any]]:
    """Each case with 1, 2, 4, ... threads and with all; the speed-up is that of the same round."""
    most = hqgs.get_num_threads()
    counts = sorted({most, *(1 << k for k in range(most.bit_length()))})

    def with_threads(case: Callable[[], Seconds], count: int) -> Callable[[], Seconds]:
        def call() -> Seconds:
            with using_threads(count):
                return warmed(case)()  # new threads start with no memory of their own

        return call

    jobs = {(name, count): with_threads(case, count) for name, case in cases.items() for count in counts}
    measured, rows = interleaved(jobs, repeats), []
    for (name, count), rounds in measured.items():
        line = {"case": name, "threads": count, "seconds": rounds["total"].median()}
        speedup = median_ratio(measured[name, 1], rounds)
        rows.append(line | {"speedup": speedup, "share": speedup / count})
    return rows


def measure_scaling(
    sizes: Sequence[int], image: Size, images: Sequence[Size], gaussians: int, repeats: int, seed: int
) -> dict[str, Any]:
    """Time against the number of Gaussians in one image, and of `gaussians` against the size of the image.

    The overlap per pixel is the same everywhere.
    """
    cloud = make_inputs(max(sizes), *image, seed)  # the smaller ones share its memory
    by_size = _curve({n: RasterPass(fitted(cloud, n, *image)) for n in sizes}, repeats)
    cloud = make_inputs(gaussians, *images[0], seed)
    passes = {w * h: RasterPass(fitted(cloud, gaussians, w, h)) for w, h in images}
    return {
        "gaussians": {"width": image[0], "height": image[1], **by_size},
        "pixels": {"gaussians": gaussians, **_curve(passes, repeats)},
        "target_exponent": TARGET,
    }


def _curve(passes: dict[int, RasterPass], repeats: int) -> dict[str, Any]:
    """Seconds of passes by what they grow with."""
    measured = interleaved({x: warmed(case) for x, case in passes.items()}, repeats)
    rows = [whole(rounds) for rounds in measured.values()]
    curve = {name: [row[name] for row in rows] for name in ("seconds", "seconds_quartiles")}
    ends = pairwise(zip(passes, curve["seconds"], strict=True))
    steepest = max(exponent(*zip(*two, strict=True)) for two in ends)  # between two neighbours
    found = {"exponent": exponent(list(passes), curve["seconds"]), "steepest": steepest}
    return {"x": list(passes), **curve, **found}


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
