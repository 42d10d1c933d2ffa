"""Peak memory of a training run, measured in a process of its own."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any

import hqgs
from benchmarks.output import UnavailableError
from benchmarks.speed.scene import make_trainer
from hqgs.base.machine import peak_rss_mb

TARGET_MB = 3000.0


def measure_memory(settings: dict[str, Any]) -> dict[str, Any]:
    """Peak resident memory in MB (10^6 bytes) after the imports, with the scene, and of the training.

    `settings`: the arguments of `make_trainer`, and the `steps`. Raises UnavailableError where the process is
    killed or runs out of memory, or the system does not tell.
    """
    settings = settings | {"threads": hqgs.get_num_threads()}
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            peaks = pool.submit(_measure, **settings).result()
        except (BrokenProcessPool, MemoryError) as error:
            raise UnavailableError(f"the process that measures the memory ended: {error}") from error
    if None in peaks.values():
        raise UnavailableError("this system does not tell the peak memory of a process")
    return {**settings, **peaks, "target_mb": TARGET_MB}


def _measure(threads: int, steps: int, **settings: Any) -> dict[str, float | None]:
    peaks = {"imports_mb": peak_rss_mb()}
    hqgs.set_num_threads(threads)
    trainer = make_trainer(**settings)
    peaks["scene_mb"] = peak_rss_mb()
    for _ in range(steps):
        trainer.step()
    return peaks | {"peak_mb": peak_rss_mb()}
