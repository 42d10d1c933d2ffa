"""What a thin lens does to a picture: each point becomes a disc, the larger the farther from the focus it is.

A lens is two numbers (slope, offset), px: a point of nearness n, which is its inverse depth with 1 at the
photo's median, becomes a disc of radius |slope n + offset|. In focus is n = -offset / slope; the sign of both
says nothing.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hqgs.photos.formation import GOLDEN

FIRST_RADIUS = 0.0015  # of the photo's width: from 0 it has no direction to grow in
LENS_NEAREST, LENS_FARTHEST = 2.0, 0.3  # nearness of what photos show, as far as sizes of discs go
FEWEST_SAMPLES, MOST_SAMPLES = 6, 24  # of the aperture


def first_lens(width: float) -> Tensor:
    """Of a photo of this width: all of it out of focus alike, by little."""
    return torch.tensor([0.0, FIRST_RADIUS * width], dtype=torch.float64)


def widest(slope: float, offset: float) -> float:
    """The largest radius, px."""
    return max(abs(slope * n + offset) for n in (LENS_NEAREST, LENS_FARTHEST))


def sharp_at(slope: float, offset: float) -> float | None:
    """The depth in focus, 1 at the photo's median; None: all that photos show is in focus, or nothing."""
    near = -offset / slope if slope else 0.0
    return 1 / near if LENS_FARTHEST <= near <= LENS_NEAREST else None


def samples(lens: Tensor) -> int:
    """How many points of the lens stand for all of it: one for 2.5 px of the largest disc."""
    return min(max(FEWEST_SAMPLES, math.ceil(math.pi * widest(*lens.tolist()) ** 2 / 2.5)), MOST_SAMPLES)


def lens_warps(lens: Tensor, count: int) -> Tensor:
    """Warps for `take_photo` of `count` points of the lens, [count, 3, 4]: shifts that go with nearness."""
    shifts = _sunflower(count)
    warps = torch.zeros(count, 3, 4, dtype=torch.float64)
    warps[:, :2, 2] = shifts * lens[1]
    warps[:, :2, 3] = shifts * lens[0]
    return warps


def _sunflower(count: int) -> Tensor:
    """Points spread evenly over the unit disc, [count, 2], of mean 0.

    Neighbours in the list lie far apart: the same warps may stand for a trajectory, one moment after another.
    """
    k = torch.arange(count, dtype=torch.float64)
    order = (k * (GOLDEN / (2 * math.pi)) % 1).argsort().double()
    radii, angles = ((order + 0.5) / count).sqrt(), GOLDEN * order
    points = torch.stack([radii * angles.cos(), radii * angles.sin()], 1)
    points -= points.mean(0)
    return points * (0.5 / points.square().sum(1).mean()).sqrt()  # the second moment of a disc
