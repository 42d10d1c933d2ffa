"""What a caller has set for the process or the thread: every call of hqgs gives what it gives without, and
leaves it as it was."""

from __future__ import annotations

import json
import random
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import random_scene
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

import hqgs
from hqgs.evaluation.metrics import evaluate_view
from hqgs.photos.pixels import as_floats


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextmanager
def default_device() -> Iterator[None]:
    torch.set_default_device("meta")
    try:
        yield
    finally:
        torch.set_default_device(None)


@contextmanager
def deterministic() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


@contextmanager
def warnings_are_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


STATES: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "float64": lambda: default_dtype(torch.float64),
    "bfloat16": lambda: default_dtype(torch.bfloat16),
    "no grad": lambda: torch.set_grad_enabled(False),
    "inference": torch.inference_mode,
    "np.seterr": lambda: np.errstate(all="raise"),
    "warnings": warnings_are_errors,
    "deterministic": deterministic,
    "default device": default_device,
    "within a device": lambda: torch.device("meta"),
    "autocast": lambda: torch.autocast("cpu"),
    "anomalies": lambda: torch.autograd.set_detect_anomaly(True, check_nan=False),
}


def state() -> dict[str, Any]:
    """What a call could leave behind."""
    return {
        "dtype": torch.get_default_dtype(),
        "device": torch.get_default_device(),
        "grad": torch.is_grad_enabled(),
        "inference": torch.is_inference_mode_enabled(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "autocast": torch.is_autocast_enabled("cpu"),
        "anomalies": torch.is_anomaly_enabled(),
        "threads": torch.get_num_threads(),
        "torch": torch.get_rng_state().tolist(),
        "numpy": np.random.get_state()[1].tolist(),  # type: ignore[union-attr, index]  # noqa: NPY002
        "random": random.getstate(),
        "errors": np.geterr(),
        "warnings": [*warnings.filters],
        "folder": Path.cwd(),
        "pixels": Image.MAX_IMAGE_PIXELS,
    }


HARMONICS = random_scene(40, 20, 14, 2, seed=3, dtype=torch.float32, sh_degree=1)
CHANNELS = random_scene(40, 20, 14, 1, seed=3, dtype=torch.float32)


def gaussians() -> hqgs.Gaussians:
    scene = tiny_scene()
    return hqgs.Gaussians.from_points(scene.points, scene.point_colors)


def rasterized(_: Path) -> list[Tensor]:
    leaves = HARMONICS.with_grad("means", "colors")
    options = {"backgrounds": [0.1, 0.2, 0.3], "render_mode": "RGB+ED", "packed": True}
    image, alphas, meta = hqgs.rasterization(**leaves.arguments(**options))
    if image.requires_grad:
        (image.square().sum() + alphas.sum()).backward()
        assert leaves.means.grad is not None
    return [image, alphas, *(value for value in meta.values() if isinstance(value, Tensor))]


def of_covariances(_: Path) -> list[Tensor]:
    covars = torch.from_numpy(np.tile(np.diag([0.01, 0.02, 0.03]).astype(np.float32), (40, 1, 1)))
    return [hqgs.rasterization(**CHANNELS.arguments(covars=covars, quats=None, scales=None))[0]]


def files(folder: Path) -> list[Tensor]:
    found = gaussians()
    for suffix in (".ply", ".spz", ".splat", ".glb", ".compressed.ply", ".sog"):
        found.save(folder / f"scene{suffix}")
        read = hqgs.Gaussians.load(folder / f"scene{suffix}")
        assert read.means.dtype == torch.float32
        assert not read.means.is_inference()
    return [*read.named().values(), found.render(tiny_scene().train[0].camera)]


def trained(_: Path) -> list[Tensor]:
    scene = tiny_scene()
    run = hqgs.train(scene, config=tiny_config(9))
    return [*run.model.named().values(), torch.from_numpy(run.views[0].render)]


def loaded(folder: Path) -> list[Tensor]:
    """A capture in Blender's layout, and a degraded copy of it."""
    for name in ("train", "test"):
        frames = [
            {"file_path": f"{name}_{k}", "transform_matrix": np.linalg.inv(view.camera.viewmat).tolist()}
            for k, view in enumerate(getattr(tiny_scene(), name))
        ]
        for frame, view in zip(frames, getattr(tiny_scene(), name), strict=True):
            Image.fromarray(view.image).save(folder / f"{frame['file_path']}.png")
        text = json.dumps({"camera_angle_x": 1.0, "frames": frames})
        (folder / f"transforms_{name}.json").write_text(text, encoding="utf-8")
    scene = hqgs.load(folder)
    worse = hqgs.degrade(scene, "blur:1.5+jpeg:20")
    return [torch.from_numpy(np.asarray(one.train[0].image)) for one in (scene, worse)]


def diagnosed(_: Path) -> list[Tensor]:
    return [torch.tensor([hash(str(hqgs.diagnose(tiny_scene()))) % 1000], device="cpu")]


def measured(_: Path) -> list[Tensor]:
    view, other = tiny_scene().train[:2]
    found = evaluate_view(as_floats(view.image), as_floats(other.image), None)
    return [torch.tensor([found.psnr, found.ssim], dtype=torch.float64, device="cpu")]


def filmed(folder: Path) -> list[Tensor]:
    scene, path = gaussians(), folder / "frames"
    hqgs.render_frames(scene, hqgs.orbit(scene, 3, like=tiny_scene().train[0].camera), path)
    return [torch.from_numpy(np.array(Image.open(file))) for file in sorted(path.glob("*.png"))]


CALLS = [rasterized, of_covariances, files, trained, loaded, diagnosed, measured, filmed]


AS_EVER: dict[str, list[Tensor]] = {}


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.__name__)
@pytest.mark.parametrize("name", STATES)
def test_a_call_gives_what_it_gives_in_a_fresh_process(
    name: str, call: Callable[[Path], list[Tensor]], tmp_path: Path
) -> None:
    if call.__name__ not in AS_EVER:
        (tmp_path / "plain").mkdir()
        AS_EVER[call.__name__] = call(tmp_path / "plain")
    with STATES[name]():
        before = state()
        found = call(tmp_path)
        after = state()
    assert after == before
    for mine, wanted in zip(found, AS_EVER[call.__name__], strict=True):
        assert mine.dtype == wanted.dtype
        assert torch.equal(mine.detach(), wanted.detach())
