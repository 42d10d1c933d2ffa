"""Peak memory of a training run, measured in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Any

import hqgs
from benchmarks.speed.scene import make_trainer
from hqgs.base.machine import peak_rss_mb

TARGET_MB = 3000.0


@dataclass(frozen=True)
class MemoryConfig:
    """What the process holds, and how long it trains."""

    gaussians: int = 1_000_000
    photos: int = 50
    width: int = 1_155
    height: int = 866
    steps: int = 20
    method: str = "3dgs"
    seed: int = 2026


def measure_memory(config: MemoryConfig) -> dict[str, Any]:
    """Peak resident memory in MB (10^6 bytes) after the imports, with the scene, and of the training.

    Raises RuntimeError with the process's last words if it fails, or if the system does not tell.
    """
    settings = asdict(config) | {"threads": hqgs.get_num_threads()}
    command = [sys.executable, "-m", "benchmarks.speed.memory", json.dumps(settings)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.splitlines() or ["no message"])[-1]
        raise RuntimeError(f"the process that measures the memory ended with {done.returncode}: {last}")
    peaks: dict[str, float | None] = json.loads(done.stdout)
    if None in peaks.values():
        raise RuntimeError("this system does not tell the peak memory of a process")
    return {**settings, **peaks, "target_mb": TARGET_MB}


def _measure(threads: int, **config: Any) -> dict[str, float | None]:
    peaks = {"imports_mb": peak_rss_mb()}
    hqgs.set_num_threads(threads)
    memory = MemoryConfig(**config)
    trainer = make_trainer(
        memory.gaussians, memory.width, memory.height, memory.photos, memory.method, memory.seed
    )
    peaks["scene_mb"] = peak_rss_mb()
    for _ in range(memory.steps):
        trainer.step()
    peaks["peak_mb"] = peak_rss_mb()
    return peaks


if __name__ == "__main__":
    print(json.dumps(_measure(**json.loads(sys.argv[1]))))
