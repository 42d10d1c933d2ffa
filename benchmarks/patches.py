"""What the benchmarks time or replace in hqgs: every name that is patched, in one place.

And what is put there: other knobs of the rasterizer, and the other choice of what makes training fast.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import conv2d

import hqgs
from benchmarks.speed.timing import using_threads
from hqgs import _rust
from hqgs._rust import ALPHA_MIN, TRANSMITTANCE_MIN
from hqgs.model import gaussians
from hqgs.model.rasterization import RasterizationMeta
from hqgs.training import forward, trainer
from hqgs.training.methods import base
from hqgs.training.trainer import Trainer

Place = tuple[Any, str]  # a module or class, and the name that its users look up there

# Replaced by the switches below.
RENDER_VIEW: Place = (forward, "render_view")
RASTERIZATION: Place = (gaussians, "rasterization")
ONE_TORCH_THREAD: Place = (trainer, "one_torch_thread")
ADAM: Place = (trainer, "Adam")
LOSS: Place = (base, "photometric_loss")

# Replaced with other knobs, and timed by benchmarks/speed with the stage that they make up.
PROJECT: Place = (_rust, "project_forward")
COMPOSITE: Place = (_rust, "composite_forward")
CRATE: dict[Place, str] = {
    PROJECT: "project",
    COMPOSITE: "bin and composite",
    (_rust, "composite_backward"): "composite backward",
    (_rust, "project_backward"): "project backward",
}


def parts_of_step(trainer: Trainer) -> dict[Place, str]:
    """The functions that a training step calls, in its order, with the part of the step that they make up.

    Each part is without the others that run inside it.
    """
    state, (project, composite, *backward) = trainer.state, CRATE.items()
    return dict(
        [
            (RENDER_VIEW, "activations"),  # of the Gaussians, and the checks of hqgs.rasterization
            ((type(trainer.method), "modulate"), "method"),  # before they are rasterized
            project,
            composite,
            ((type(trainer.method), "loss"), "loss"),
            ((torch.Tensor, "backward"), "autograd"),  # of the activations, and torch's own work
            *backward,
            ((type(state.densifier), "observe"), "density statistics"),
            ((type(state.densifier), "update"), "density statistics"),
            ((type(state.optimizer), "step"), "Adam"),
        ]
    )


@dataclass(frozen=True)
class Knobs:
    """The settings of `AccuracyKnobs` in rust/accuracy_knobs.rs, and the dtype."""

    dtype: str = "float32"
    alpha_min: float = ALPHA_MIN  # smallest alpha that is blended
    transmittance_min: float = TRANSMITTANCE_MIN  # compositing stops there
    spans: str = "ellipse"  # the tiles of a Gaussian: of its support, or of its "box"
    skip_blocks: bool = True  # leave out the 4 x 4 blocks that a Gaussian does not reach


@contextmanager
def tuned(knobs: Knobs) -> Iterator[None]:
    """Inside it the rasterizer has these knobs, the dtype aside."""
    _, *values = asdict(knobs).values()
    with patch.object(*PROJECT, partial(getattr(*PROJECT), knobs=tuple(values))):
        yield


SSIM_WINDOW, SSIM_SIGMA = 11, 1.5


@contextmanager
def _in_torch(place: Place, function: Any) -> Iterator[None]:
    """What torch does instead of the crate may use as many threads as the crate."""
    before = torch.get_num_threads()
    torch.set_num_threads(hqgs.get_num_threads())
    try:
        with patch.object(*ONE_TORCH_THREAD, nullcontext), patch.object(*place, function):
            yield
    finally:
        torch.set_num_threads(before)


def in_float64(*args: Any, **options: Any) -> tuple[Tensor, Tensor, RasterizationMeta]:
    """`hqgs.rasterization` in float64; the image is float32 again."""

    def double(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(double, value))
        return value.double() if isinstance(value, Tensor) else value

    options = {name: double(value) for name, value in options.items()}
    images, alphas, meta = hqgs.rasterization(*map(double, args), **options)
    return images.float(), alphas.float(), meta


def torch_loss(
    render: Tensor, target: Tensor, mask: Tensor | None = None, lambda_dssim: float = 0.2
) -> Tensor:
    """`photometric_loss` from torch's operations and autograd, as the field writes it."""
    from kornia.filters import get_gaussian_kernel2d  # here: it takes seconds

    photo = target.to(render.dtype) / 255 if target.dtype == torch.uint8 else target
    counted = slice(None) if mask is None else mask
    l1 = (render - photo)[counted].abs().mean()
    if mask is not None:
        render = torch.where(mask[..., None], render, photo)
    x, y = (image.permute(2, 0, 1)[None] for image in (render, photo))
    window = get_gaussian_kernel2d(SSIM_WINDOW, (SSIM_SIGMA, SSIM_SIGMA), dtype=render.dtype)
    window = window.expand(x.shape[1], 1, -1, -1).contiguous()
    blur = partial(conv2d, weight=window, padding=SSIM_WINDOW // 2, groups=x.shape[1])
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    ssim = ssim / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim.mean())


class TorchAdam(torch.optim.Adam):
    """torch's own Adam behind the trainer's call."""

    def step(self, closure: Any = None) -> Any:
        return super().step(closure)


SWITCHES: dict[str, Callable[[], Any]] = {  # context managers: inside them the other choice is in place
    "": nullcontext,
    "float64": partial(patch.object, *RASTERIZATION, in_float64),
    "boxes": partial(tuned, Knobs(spans="box")),
    "every block": partial(tuned, Knobs(skip_blocks=False)),
    "torch's loss": partial(_in_torch, LOSS, torch_loss),
    "torch's Adam": partial(_in_torch, ADAM, TorchAdam),
    "one thread": partial(using_threads, 1),
}
