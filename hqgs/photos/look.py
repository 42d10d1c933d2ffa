"""The look of a photo: gains, and what its camera does to all its photos, vignetting and response.

The light l of a pixel at distance r from the lens's axis, where half the diagonal is 1, becomes the value
R(s(g l exp(-k1 r^2 - k2 r^4))), where s is the curve of sRGB and R(v) = v + v (1 - v) (a + b (1 - 2 v)),
for red, green and blue each: black and white stay. With u = 1 - 2 v its slope is 1 + a P1(u) + b P2(u),
Legendre's polynomials: it rises as long as |a| + |b| < 1. Beyond 0 and 1 it goes on straight.

The parts are those of PPISP, in fewer numbers: too few to take over what the scene should explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.base.elementary import exp
from hqgs.photos.light import EXPONENT, OFFSET, to_linear, to_srgb


@dataclass(frozen=True)
class Look:
    """Of one photo."""

    gains: NDArray[np.float64]  # [3], of red, green and blue in linear light
    vignetting: NDArray[np.float64]  # [2], k1 and k2
    response: NDArray[np.float64]  # [2, 3], a and b of red, green and blue

    def of(self, image: NDArray[Any], K: NDArray[np.float64]) -> NDArray[np.float64]:
        """A picture [H, W, 3], values of sRGB, in this look; `K` [3, 3] has the axis, px."""
        square = torch.from_numpy(squared_radii(image.shape[0], image.shape[1], K))
        light = to_linear(image.astype(np.float64)) * self.gains
        light *= np.exp(-falloff(square, torch.from_numpy(self.vignetting)).numpy())[..., None]
        values = torch.from_numpy(to_srgb(light).transpose(2, 0, 1))
        return respond(values, torch.from_numpy(self.response)).numpy().transpose(1, 2, 0)


def squared_radii(height: int, width: int, K: NDArray[np.float64]) -> NDArray[np.float64]:
    """r^2 of each pixel, [H, W], where half the diagonal is 1."""
    y, x = np.ogrid[:height, :width]
    square = np.square(x + 0.5 - K[0, 2]) + np.square(y + 0.5 - K[1, 2])
    return square * (4 / (height**2 + width**2))


def falloff(square: Tensor, vignetting: Tensor) -> Tensor:
    """The negative logarithm of what a lens lets through at these r^2; `vignetting` [2]."""
    return square * (vignetting[0] + square * vignetting[1])


def darken(values: Tensor, fall: Tensor) -> Tensor:
    """Values [3, H, W] of sRGB with their light times exp(-fall), [H, W].

    Exact but where light goes from the curve into its toe: there by half a level at a third of the light.
    """
    fall = fall.to(values.dtype)
    root, straight = exp(fall / -EXPONENT), exp(-fall)
    curved, straight = (values + OFFSET) * root - OFFSET, values * straight
    if bool((fall >= 0).all()):
        return torch.maximum(curved, straight)
    return torch.where(fall > 0, torch.maximum(curved, straight), torch.minimum(curved, straight))


def respond(values: Tensor, response: Tensor) -> Tensor:
    """Values [3, H, W] as a camera of this response [2, 3] writes them."""
    a, b = response.to(values.dtype)[..., None, None]
    inside = values.clamp(0, 1)
    u = 1 - 2 * inside
    bend = inside * (1 - inside) * (a + b * u)
    slope = 1 + a * u + b * (1.5 * u * u - 0.5)
    return inside + bend + (values - inside) * slope
