"""Where a scene is, and a first camera to look at it, of which nothing but the Gaussians is known."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hqgs.scene.paths import circle
from hqgs.scene.scene import Camera


def content(means: Tensor, opacities: Tensor) -> tuple[NDArray[np.float64], float]:
    """Where most of a scene is: the middle [3] and a radius, world units, of `means` [N, 3].

    Each Gaussian counts by its opacity, of which `opacities` [N] are logits. The middle is the median along
    each axis, and 80 % lie within the radius, so that a few that are far away do not matter.

    Raises ValueError where there is no Gaussian that is finite and can be seen.
    """
    points = means.detach().double().numpy()
    weights = torch.sigmoid(opacities.detach().double()).numpy()
    seen = np.isfinite(points).all(axis=1) & (weights > 0)
    if not seen.any():
        raise ValueError("the scene is empty: it has no Gaussian that can be seen")
    points, weights = points[seen], weights[seen]
    middle = np.array([_quantile(points[:, axis], weights, 0.5) for axis in range(3)])
    radius = _quantile(np.linalg.norm(points - middle, axis=1), weights, 0.8)
    return middle, radius or 1.0


def around(means: Tensor, opacities: Tensor, frames: int, up: ArrayLike, like: Camera | None) -> list[Camera]:
    """Cameras on a circle around the content, a little above it."""
    middle, radius = content(means, opacities)
    away = 2.2 * radius  # from where it fills the picture
    return circle(middle, away, height=0.35 * away, frames=frames, up=up, like=like)


def _quantile(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, share * total[-1])])
