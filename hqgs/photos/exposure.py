"""How a camera takes a render: the mean over the exposure in linear light, with gains. In the crate."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs import _rust


def take_photo(
    image: Tensor, size: tuple[int, int], nearness: Tensor | None, warps: Tensor, gains: Tensor
) -> Tensor:
    """The photo [H, W, 3] of a render [H + 2 m, W + 2 m, 3] with a margin of m px; sRGB values, white at 1.

    `gains` times the mean over `warps` of the render's light. Each warp [3, 4] is a matrix less the identity
    that takes a pixel of the photo (x, y, 1, nearness) to where the render shows it, (x, y, 1) times w > 0;
    pixels' centres lie at halves. Beyond its border the render goes on as it ends.

    Args:
        image: float32 or float64.
        size: (H, W).
        nearness: [H, W], the inverse depth that the warps refer to, of the image's dtype; gets no gradient.
            None: 0.
        warps: [K, 3, 4], float64; with K = 0 the picture stands still.
        gains: [3], float64, of red, green and blue in linear light.

    Raises:
        ValueError: a wrong shape, dtype or value, with its name.
    """
    return _TakePhoto.apply(image, size, nearness, warps, gains)


class _TakePhoto(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, size, nearness, warps: Tensor, gains: Tensor) -> Tensor:
        near = None if nearness is None else nearness.detach().contiguous().numpy()
        state, photo = _rust.exposure_forward(
            image.detach().contiguous().numpy(),
            list(size),
            near,
            warps.detach().contiguous().numpy(),
            gains.detach().tolist(),
        )
        ctx.state, ctx.shape = state, image.shape
        return torch.from_numpy(photo).view(*size, 3)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_photo: Tensor
    ) -> tuple[Tensor, None, None, Tensor, Tensor]:
        v_image, v_warps, v_gains = _rust.exposure_backward(ctx.state, v_photo.contiguous().numpy())
        return (
            torch.from_numpy(v_image).view(ctx.shape),
            None,
            None,
            torch.from_numpy(v_warps).view(-1, 3, 4),
            torch.tensor(v_gains, dtype=torch.float64),
        )
