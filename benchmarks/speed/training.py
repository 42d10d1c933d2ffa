"""A trainer at the size that is asked for: where the time of a step goes, the memory of its process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import hqgs
from benchmarks.command import UnavailableError
from benchmarks.patches import parts_of_step
from benchmarks.speed.inputs import FAR, LEAVES, NEAR, RasterInputs, make_inputs
from benchmarks.speed.timing import Seconds, StageClock, interleaved, median_ratio, whole
from hqgs.base.machine import peak_rss_mb
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import DensifyConfig, HQGSConfig, TrainConfig
from hqgs.training.trainer import Trainer

TINY = 1e-6  # learning rates: the same arithmetic, and the scene stays what it is while it is timed


def make_trainer(
    gaussians: int,
    width: int,
    height: int,
    photos: int,
    method: str,
    seed: int,
    options: HQGSConfig | None = None,
    warm: bool = False,
) -> Trainer:
    """A trainer at the Gaussians of `make_inputs` whose steps do all the work of a step, the statistics for
    their number included, but change next to nothing.

    `options`: of method hqgs. `warm`: it has made the steps until all harmonics are trained. ValueError as
    `make_inputs` and `Trainer` have it.
    """
    inputs, iterations = make_inputs(gaussians, width, height, seed), 1_000_000
    rng = np.random.default_rng(seed)
    views = [
        View(f"{k:03d}", camera, rng.integers(0, 256, (height, width, 3), dtype=np.uint8))
        for k, camera in enumerate(_cameras(inputs, photos, rng))
    ]
    scene = Scene("cloud", views, [], inputs.means, np.zeros(inputs.means.shape, np.uint8), "benchmark")
    still = DensifyConfig(start=iterations, stop=iterations, reset_every=iterations, max_gaussians=gaussians)
    given: dict[str, Any] = {"hqgs": options or HQGSConfig(), "leave_out": (), "densify": still}
    config = TrainConfig(iterations, method, seed, sh_interval=1, **given)
    config = replace(config, **{name: TINY for name in vars(config) if name.startswith("lr_")})
    trainer = Trainer(scene, config)
    means, quats, scales, opacities, sh = (torch.from_numpy(getattr(inputs, name)) for name in LEAVES)
    start = Gaussians(means, scales.log(), quats, opacities.logit(), sh[:, :1], sh[:, 1:])
    with torch.no_grad():
        for name, tensor in trainer.gaussians.named().items():
            tensor.copy_(getattr(start, name))
    for _ in range(config.sh_degree if warm else 0):
        trainer.step()
    return trainer


def _cameras(inputs: RasterInputs, count: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras that look at the middle of the cloud from about the same side, a few degrees apart."""
    middle = np.array([0, 0, (NEAR + FAR) / 2])
    cameras = []
    for _ in range(count):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.05, 0.05, 3)).as_matrix()
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        cameras.append(Camera(inputs.width, inputs.height, inputs.K, turn @ inputs.viewmat))
    return cameras


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
    return settings | peaks


def _measure(threads: int, steps: int, **settings: Any) -> dict[str, float | None]:
    peaks = {"imports_mb": peak_rss_mb()}
    hqgs.set_num_threads(threads)
    trainer = make_trainer(**settings)
    peaks["scene_mb"] = peak_rss_mb()
    for _ in range(steps):
        trainer.step()
    return peaks | {"peak_mb": peak_rss_mb()}


def whole_step(trainer: Trainer) -> Callable[[], Seconds]:
    """A step of which only the whole is timed."""
    return lambda: StageClock().seconds(trainer.step, [])


def step_by_parts(trainer: Trainer) -> Callable[[], Seconds]:
    """A step with a clock around each part."""
    clock, parts = StageClock(), parts_of_step(trainer)

    def call() -> Seconds:
        with clock.watching(parts):
            return clock.seconds(trainer.step, parts.values())

    return call


def measure_steps(trainers: Mapping[str, Trainer], repeats: int) -> list[dict[str, Any]]:
    """Seconds of a step and of its parts, for each trainer; `case`: its key, `ratio`: over the first one."""
    ways = {"whole": whole_step, "parts": step_by_parts}
    cases = {(name, way): time(t) for name, t in trainers.items() for way, time in ways.items()}
    measured = interleaved(cases, repeats)
    first, rows = next(iter(measured.values())), []
    for name, trainer in trainers.items():
        camera, n = trainer.scene.train[0].camera, len(trainer.gaussians)
        rounds, parts = measured[name, "whole"], measured[name, "parts"]
        row = {"case": name, "gaussians": n, "width": camera.width, "height": camera.height}
        row |= whole(rounds) | {"ratio": median_ratio(rounds, first)}
        rows.append(row | {"stages": parts.drop(columns="total").median().to_dict()})
    return rows
