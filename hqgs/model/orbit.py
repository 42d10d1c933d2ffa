"""A path around a scene of which nothing but the Gaussians is known, or its cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from hqgs.model.gaussians import Gaussians
from hqgs.scene.paths import UP, circle, orbit_cameras
from hqgs.scene.scene import Camera

SHARE = 0.8  # of what there is to see, which lies within the radius of `content`
DISTANCE = 2.2  # from the middle, in such radii: they fill the picture then
RAISED = 0.35  # of the distance


def content(gaussians: Gaussians) -> tuple[NDArray[np.float64], float]:
    """Where most of a scene is: the middle [3] and a radius, world units.

    Each Gaussian counts by its opacity. The middle is the median along each axis, and 80 % lie within the
    radius, so that a few that are far away do not matter.

    Raises ValueError where there is no Gaussian that is finite and can be seen.
    """
    means = gaussians.means.detach().double().numpy()
    weights = torch.sigmoid(gaussians.opacities.detach().double()).numpy()
    seen = np.isfinite(means).all(axis=1) & (weights > 0)
    if not seen.any():
        raise ValueError("the scene is empty: it has no Gaussian that can be seen")
    means, weights = means[seen], weights[seen]
    middle = np.array([_quantile(means[:, axis], weights, 0.5) for axis in range(3)])
    radius = _quantile(np.linalg.norm(means - middle, axis=1), weights, SHARE)
    return middle, radius or 1.0


def orbit(
    about: Gaussians | Sequence[Camera],
    frames: int = 120,
    *,
    up: ArrayLike = UP,
    like: Camera | None = None,
) -> list[Camera]:
    """Cameras on a way around a scene, all of which look at its middle.

    Args:
        about: the Gaussians, or cameras that look at the scene, such as those of the training views. The
            cameras say how far away and how high the way is, and where up is; if they stand on one side
            only, it is a small ellipse on that side.
        frames: how many, at least 1.
        up: [3], the axis of the orbit of Gaussians. Files of 3DGS have y down.
        like: the camera whose size and intrinsics the orbit of Gaussians has; None: 504 x 378 px, 60 degrees.

    Raises:
        ValueError: no camera, no frame, or no Gaussian that can be seen.
    """
    if not isinstance(about, Gaussians):
        return orbit_cameras(about, frames)
    middle, radius = content(about)
    away = DISTANCE * radius
    return circle(middle, away, height=RAISED * away, frames=frames, up=up, like=like)


def _quantile(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, share * total[-1])])
