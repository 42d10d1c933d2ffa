"""Other implementations of the same function on the same inputs, where they are installed."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks.output import UnavailableError
from benchmarks.speed.inputs import RasterInputs
from benchmarks.speed.rasterizer import RasterPass
from benchmarks.speed.timing import Seconds, StageClock, interleaved, median_ratio


def find_gsplat() -> Callable[..., Any]:
    """gsplat's rasterization. UnavailableError says why there is none here."""
    if importlib.util.find_spec("gsplat") is None:
        raise UnavailableError("gsplat is not installed")
    if not torch.cuda.is_available():
        raise UnavailableError("gsplat rasterizes on CUDA devices only, and torch finds none")
    return importlib.import_module("gsplat").rasterization


def measure_gsplat(inputs: Sequence[RasterInputs], repeats: int) -> list[dict[str, Any]]:
    """Forward and backward of gsplat on the GPU beside ours on the CPU; UnavailableError as `find_gsplat`."""
    rasterization, rows = find_gsplat(), []
    for x in inputs:
        cases = {"hqgs": RasterPass(x), "gsplat": _on_cuda(RasterPass(x, rasterization, "cuda"))}
        ours, theirs = interleaved(cases, repeats).values()
        line = {
            "gaussians": len(x),
            "device": torch.cuda.get_device_name(),
            "ratio": median_ratio(ours, theirs),
        }
        rows.append(line | {"seconds": theirs["total"].median(), "hqgs_seconds": ours["total"].median()})
    return rows


def _on_cuda(raster_pass: RasterPass) -> Callable[[], Seconds]:
    def run() -> None:
        raster_pass.run()
        torch.cuda.synchronize()

    def call() -> Seconds:
        torch.cuda.synchronize()
        seconds = StageClock().seconds(run, [])
        raster_pass.clear()
        return seconds

    return call
