"""A path around a scene of which nothing but the Gaussians is known, or its cameras."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from hqgs.model.content import around
from hqgs.model.gaussians import Gaussians
from hqgs.scene.paths import UP, orbit_cameras
from hqgs.scene.scene import Camera


def orbit(
    about: Gaussians | Sequence[Camera],
    frames: int = 120,
    *,
    up: ArrayLike | None = None,
    like: Camera | None = None,
) -> list[Camera]:
    """Cameras on a path around a scene, all of which look at its middle.

    Args:
        about: the Gaussians, or cameras that look at the scene, such as those of the training views. The
            cameras say how far away and how high the path is; if they stand on one side only, it is a small
            ellipse on that side.
        frames: how many, at least 1.
        up: [3], the axis of the orbit; None: up as most of the cameras were held, and of Gaussians 0 -1 0,
            as files of 3DGS have y down.
        like: the camera whose size and intrinsics the orbit of Gaussians has; None: 504 x 378 px, 60 degrees.

    Raises:
        ValueError: no camera, no frame, or no Gaussian that can be seen.
    """
    if not isinstance(about, Gaussians):
        return orbit_cameras(about, frames, up)
    return around(about.means, about.opacities, frames, UP if up is None else up, like)
