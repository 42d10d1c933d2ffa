"""Hand shake: a smooth random path through the exposure, and the kernel that it draws."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WEAKEST = 0.2  # of the longest extent: how far the stillest photo moves
TURN = 0.6  # radians, standard deviation of the turn from one stretch of a path to the next; chosen by hand
SAMPLES_PER_PX = 8  # along a path, at least; a kernel is a mean over them


def draw_path(rng: np.random.Generator, extent: float) -> Floats:
    """The knots [4, 2] of a random path in the plane, which `path_points` runs along.

    Three stretches: the first in any direction, each next turned by N(0, 0.6) radians, their lengths uniform
    in [0.5, 1.5] before the whole is scaled. The path's mean over time is (0, 0) and its extent, the largest
    distance between two of its points, is `extent`.
    """
    headings = rng.uniform(0, 2 * math.pi) + np.cumsum([0.0, *rng.normal(0, TURN, 2)])
    lengths = rng.uniform(0.5, 1.5, 3)
    stretches = lengths[:, None] * np.stack([np.cos(headings), np.sin(headings)], -1)
    knots = np.concatenate([np.zeros((1, 2)), np.cumsum(stretches, axis=0)])
    knots -= knots_mean(knots)
    return knots * (extent / path_extent(knots))


def path_points(knots: Floats, times: Floats) -> Floats:
    """Where the path is at `times` [N] in [-1/2, 1/2], [N, D]: the cubic through four knots [4, D].

    The knots are reached at -1/2, -1/6, 1/6 and 1/2.
    """
    at = np.array([-0.5, -1 / 6, 1 / 6, 0.5])
    weights = np.ones((len(times), 4))
    for k in range(4):
        for other in range(4):
            if other != k:
                weights[:, k] *= (times - at[other]) / (at[k] - at[other])
    return weights @ knots


def knots_mean(knots: Floats) -> Floats:
    """The path's mean over time, [D]: Simpson's 3/8 rule, which is exact for a cubic."""
    return np.array([1.0, 3.0, 3.0, 1.0]) @ knots / 8


def exposure_times(count: int) -> Floats:
    """The middles of `count` equal parts of the exposure, in (-1/2, 1/2)."""
    return (np.arange(count) + 0.5) / count - 0.5


def path_extent(knots: Floats) -> float:
    """The largest distance between two of 65 points of the path, its ends among them."""
    points = path_points(knots, np.linspace(-0.5, 0.5, 65))
    return float(np.linalg.norm(points[:, None] - points, axis=-1).max())


def path_length(knots: Floats) -> float:
    """The path's length, to 1e-3 of it."""
    points = path_points(knots, np.linspace(-0.5, 0.5, 257))
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())


def shake_kernel(knots: Floats) -> Floats:
    """The kernel of a path in px (x right, y down): square, of odd size, sum 1, centroid in the middle.

    Convolving with it is the mean of the photo over its shifts, by bilinear interpolation, to the points of
    the path at N equal steps of the exposure, N at least 64 and 8 per px of the path's length.
    """
    count = max(64, SAMPLES_PER_PX * math.ceil(path_length(knots)))
    points = path_points(knots, exposure_times(count))
    points -= points.mean(axis=0)  # of the samples; the path's own is off by 1e-4 px
    reach = math.ceil(np.abs(points).max())
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    corner = np.floor(points)
    for step in np.indices((2, 2)).reshape(2, -1).T:
        share = (1 - np.abs(points - corner - step)).prod(axis=1) / count
        column, row = (corner + step).astype(np.int64).T + reach
        np.add.at(kernel, (np.minimum(row, 2 * reach), np.minimum(column, 2 * reach)), share)
    return kernel


def draw_strength(rng: np.random.Generator) -> float:
    """How strong one photo's share is, uniform in [0.2, 1]."""
    return rng.uniform(WEAKEST, 1)
