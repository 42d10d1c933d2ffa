"""The look of a photo: gains, and what its camera does to all its photos, vignetting and response.

The light l of a pixel at distance r from the lens's axis, where half the diagonal is 1, becomes the value
R(s(g l exp(-k1 r^2 - k2 r^4))), where s is the curve of sRGB and R(v) = v + v (1 - v) (a + b (1 - 2 v)),
for red, green and blue each: black and white stay. With u = 1 - 2 v its slope is 1 + a P1(u) + b P2(u),
Legendre's polynomials: it rises as long as |a| + |b| < 1. Beyond 0 and 1 it goes on straight.

The parts are those of PPISP, in fewer numbers: too few to take over what the scene should explain. What no
lens and no sensor does is none of them (`as_a_lens`, `as_responses`).
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

MOST_FALL = 2 * np.log(2)  # two stops, in a corner; wide lenses of phones lose 1 to 1.5
STEEPEST = 0.9  # |a| + |b| of a response at most: below 1 it rises
MOST_GAIN = 4 * np.log(2)  # of the logarithm of a gain, to either side: what `exposure:EV` takes


@dataclass(frozen=True)
class Look:
    """Of one photo."""

    gains: NDArray[np.float64]  # [3], of red, green and blue in linear light
    vignetting: NDArray[np.float64]  # [2], k1 and k2
    response: NDArray[np.float64]  # [2, 3], a and b of red, green and blue

    @property
    def changes(self) -> bool:
        """Whether it is another than that of the scene."""
        gains = np.abs(np.log(self.gains)).max() > 1e-9
        return bool(gains or self.vignetting.any() or self.response.any())

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


def as_a_lens(vignetting: NDArray[np.float64]) -> NDArray[np.float64]:
    """k1 and k2 [..., 2] of a lens: from the axis to the corner light falls, and by MOST_FALL at most.

    Bounded are the slopes of the fall over r^2 on the axis, k1, and in the corner, k1 + 2 k2.
    """
    slopes = np.stack([vignetting[..., 0], vignetting @ [1.0, 2.0]], -1)
    bounded = slopes.clip(0)
    bounded *= MOST_FALL / bounded.mean(-1, keepdims=True).clip(MOST_FALL)
    changed = (bounded != slopes).any(-1, keepdims=True)
    return np.where(changed, bounded @ [[1.0, -0.5], [0.0, 0.5]], vignetting)


def as_responses(each: NDArray[np.float64]) -> NDArray[np.float64]:
    """a and b [D, 2, 3] of cameras whose values rise: where one's would not, all are made smaller, so that
    their mean over photos stays 0."""
    return each * (STEEPEST / np.abs(each).sum(1, keepdims=True).clip(STEEPEST)).min(0)


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
