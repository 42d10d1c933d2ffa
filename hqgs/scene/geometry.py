"""Projection: the one place that takes points to pixels and back."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs._rust import NEAR_PLANE
from hqgs.scene.scene import Camera, Scene, View

MARGIN = 1.15  # of the half field of view: a Gaussian just outside the picture still reaches into it


def unproject(
    camera: Camera, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points [M, 3], world, at view-space `depths` [M] behind `pixels` [M, 2], x and y."""
    in_camera = np.linalg.solve(camera.K, np.stack([*pixels.T, np.ones(len(pixels))])) * depths
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    return (in_camera - t[:, None]).T @ R


def project(camera: Camera, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels [M, 2], x and y, and view-space depths [M] of `points` [M, 3], world.

    Nothing is left out: pixels of points behind the camera mean nothing, and are not finite at depth 0.
    """
    inside = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depths = inside[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (inside @ camera.K.T)[:, :2] * (1 / depths)[:, None], depths


def median_depth(scene: Scene, view: View) -> float:
    """Of the points that the view sees, or of all in front of it where the scene does not tell; else 1."""
    rows = None if scene.seen is None else scene.seen.get(view.name)
    points = scene.points if rows is None or not len(rows) else scene.points[rows]
    depths = project(view.camera, points.astype(np.float64))[1]
    front = depths[depths > NEAR_PLANE]
    return float(np.median(front)) if front.size else 1.0


def photo_pixels(means: Tensor, views: list[View]) -> Tensor:
    """The size of a pixel of the training view that sees each mean best, world units, [N].

    depth / focal length, the smallest over the views that have the mean in their picture (Mip-Splatting, Yu
    et al. 2024, equation 7). A mean that no view sees gets the median of the others; 0 if none sees any.
    """
    best = torch.full((len(means),), torch.inf, dtype=torch.float64)
    means = means.detach().double()
    for view in views:
        depth, seen = in_picture(means, view.camera)
        size = depth / max(view.camera.K[0, 0], view.camera.K[1, 1])
        best = torch.where(seen & (size < best), size, best)
    seen = torch.isfinite(best)
    best[~seen] = best[seen].median() if seen.any() else 0.0
    return best


def in_picture(means: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """View-space depths [N] of means [N, 3] (float64), and whether they are in the picture, bool [N]."""
    viewmat, K = torch.from_numpy(camera.viewmat), camera.K
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    seen = (
        (z > NEAR_PLANE)
        & (x.abs() * K[0, 0] < MARGIN * camera.width / 2 * z)
        & (y.abs() * K[1, 1] < MARGIN * camera.height / 2 * z)
    )
    return z, seen
