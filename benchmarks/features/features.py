"""What makes training fast, each with a switch that turns it off (or on, where it is off by default)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import conv2d

import hqgs
from benchmarks.accuracy.knobs import Knobs, tuned
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Camera
from hqgs.training import trainer as trainer_module
from hqgs.training.config import TrainConfig
from hqgs.training.methods import base as three_dgs

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5


@dataclass(frozen=True)
class Feature:
    """One choice that is made for speed, and how to train with the other one."""

    name: str
    other: str  # what is done instead in the run of this feature
    by_default: bool  # whether the product has it on
    switch: Callable[[], Any] = nullcontext  # a context manager: inside it the other choice is in place
    config: Callable[[TrainConfig], TrainConfig] = lambda config: config
    refinable: bool = True  # False: it is about how Gaussians start, which trained ones cannot tell


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = hqgs.get_num_threads()
    hqgs.set_num_threads(count)
    try:
        yield
    finally:
        hqgs.set_num_threads(before)


@contextmanager
def _torch_with_all_threads() -> Iterator[None]:
    """What torch does instead of the crate may use as many threads as the crate."""
    before = torch.get_num_threads()
    torch.set_num_threads(hqgs.get_num_threads())
    try:
        with patch.object(trainer_module, "one_torch_thread", nullcontext):
            yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _in_torch(owner: Any, name: str, function: Any) -> Iterator[None]:
    with ExitStack() as stack:
        stack.enter_context(_torch_with_all_threads())
        stack.enter_context(patch.object(owner, name, function))
        yield


def render_in_float64(
    gaussians: Gaussians, camera: Camera, sh_degree: int, background: tuple[float, float, float]
) -> tuple[Tensor, dict[str, Any]]:
    """`hqgs.render.render_view` with a rasterizer in float64; the image is float32 again."""
    images, _, meta = hqgs.rasterization(
        gaussians.means.double(),
        gaussians.quats.double(),
        gaussians.activated_scales().double(),
        gaussians.activated_opacities().double(),
        (gaussians.sh0.double(), gaussians.shN.double()),
        torch.tensor(camera.viewmat[None]),
        torch.tensor(camera.K[None]),
        camera.width,
        camera.height,
        sh_degree=sh_degree,
        backgrounds=torch.tensor([background], dtype=torch.float64),
    )
    return images[0].float(), meta


def torch_loss(
    render: Tensor, target: Tensor, mask: Tensor | None = None, lambda_dssim: float = 0.2
) -> Tensor:
    """`hqgs.losses.photometric_loss` from torch's operations and autograd, as the field writes it."""
    photo = target.to(render.dtype) / 255 if target.dtype == torch.uint8 else target
    counted = slice(None) if mask is None else mask
    l1 = (render - photo)[counted].abs().mean()
    if mask is not None:
        render = torch.where(mask[..., None], render, photo)
    x, y = (image.permute(2, 0, 1)[None] for image in (render, photo))
    steps = torch.arange(SSIM_WINDOW, dtype=render.dtype) - SSIM_WINDOW // 2
    row = torch.exp(-(steps**2) / (2 * SSIM_SIGMA**2))
    row = row / row.sum()
    channels = x.shape[1]
    window = (row[:, None] * row).expand(channels, 1, -1, -1).contiguous()
    blur = partial(conv2d, weight=window, padding=SSIM_WINDOW // 2, groups=channels)
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    ssim = ssim / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim.mean())


class TorchAdam(torch.optim.Adam):
    """torch's own Adam behind the trainer's call."""

    def step(self, closure: Any = None, visible: Tensor | None = None) -> Any:
        assert visible is None  # it always updates every row
        return super().step(closure)


FEATURES = (
    Feature(
        "float32 rasterizer",
        "float64",
        True,
        partial(patch.object, trainer_module, "render_view", render_in_float64),
    ),
    Feature("exact spans of tiles", "bounding boxes", True, partial(tuned, Knobs(spans="box"))),
    Feature("skipping of blocks", "every block of a tile", True, partial(tuned, Knobs(skip_blocks=False))),
    Feature("fused loss", "torch", True, partial(_in_torch, three_dgs, "photometric_loss", torch_loss)),
    Feature("fused Adam", "torch", True, partial(_in_torch, trainer_module, "Adam", TorchAdam)),
    Feature(
        "rising SH degree",
        "degree 3 from the start",
        True,
        config=lambda config: replace(config, sh_interval=1),
        refinable=False,
    ),
    Feature("all threads", "1 thread", True, partial(_threads, 1)),
    Feature("selective Adam", "on", False, config=lambda config: replace(config, selective_adam=True)),
)
