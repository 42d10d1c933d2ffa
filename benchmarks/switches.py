"""What makes training fast, each with a switch that puts the other choice in place for a while."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import conv2d

import hqgs
from benchmarks import places
from benchmarks.accuracy import Knobs, tuned
from benchmarks.speed.timing import using_threads
from hqgs.model.rasterization import RasterizationMeta

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5


@contextmanager
def _in_torch(place: places.Place, function: Any) -> Iterator[None]:
    """What torch does instead of the crate may use as many threads as the crate."""
    before = torch.get_num_threads()
    torch.set_num_threads(hqgs.get_num_threads())
    try:
        with ExitStack() as stack:
            stack.enter_context(patch.object(*places.ONE_TORCH_THREAD, nullcontext))
            stack.enter_context(patch.object(*place, function))
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


SWITCHES: dict[str, Callable[[], Any]] = {  # context managers: inside them the other choice is in place
    "": nullcontext,
    "float64": partial(patch.object, *places.RASTERIZATION, in_float64),
    "boxes": partial(tuned, Knobs(spans="box")),
    "every block": partial(tuned, Knobs(skip_blocks=False)),
    "torch's loss": partial(_in_torch, places.LOSS, torch_loss),
    "torch's Adam": partial(_in_torch, places.ADAM, TorchAdam),
    "one thread": partial(using_threads, 1),
}
