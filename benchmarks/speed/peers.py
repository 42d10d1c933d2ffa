"""Other implementations of the same function on the same inputs, where they are installed."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks.speed.inputs import RasterInputs
from benchmarks.speed.rasterizer import RasterPass
from benchmarks.speed.timing import Seconds, StageClock, interleaved, median, median_ratio


def find_gsplat() -> Callable[..., Any]:
    """gsplat's rasterization. RuntimeError says why there is none here."""
    if importlib.util.find_spec("gsplat") is None:
        raise RuntimeError("gsplat is not installed")
    if not torch.cuda.is_available():
        raise RuntimeError("gsplat rasterizes on CUDA devices only, and torch finds none")
    return importlib.import_module("gsplat").rasterization


def measure_gsplat(inputs: Sequence[RasterInputs], repeats: int) -> list[dict[str, Any]]:
    """Forward and backward of gsplat on the GPU beside ours on the CPU; RuntimeError as `find_gsplat`."""
    rasterization = find_gsplat()
    cases: dict[str, Callable[[], Seconds]] = {}
    for x in inputs:
        cases[f"{len(x)}/hqgs"] = RasterPass(x)
        cases[f"{len(x)}/gsplat"] = _on_cuda(RasterPass(x, rasterization, "cuda"))
    measured = interleaved(cases, repeats)
    return [
        {
            "gaussians": len(x),
            "seconds": median(measured[f"{len(x)}/gsplat"]),
            "hqgs_seconds": median(measured[f"{len(x)}/hqgs"]),
            "ratio": median_ratio(measured[f"{len(x)}/hqgs"], measured[f"{len(x)}/gsplat"]),
            "device": torch.cuda.get_device_name(),
        }
        for x in inputs
    ]


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
