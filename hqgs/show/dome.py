"""A dome behind a merged scene: the sky, which each part hung somewhere else and cropping tears."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from hqgs.model.constants import SH_C0
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import composited
from hqgs.scene.geometry import resized_camera, unproject
from hqgs.scene.scene import Camera

DIRECTIONS = 1 << 15  # about a degree apart
FAR = 100.0  # radii of the cameras' positions: then half a degree of parallax is left
WIDTH = 0.6  # of the distance between two directions: standard deviation of each
OPACITY = 0.99
SIDE = 320  # px, the longer one of the pictures that are compared
CAMERAS = 64  # of each part, evenly spread over its photos
LEAST = 1.0  # whole pixels through which a direction must be seen


class Dome:
    """Finds the colours that make up for what the merged scene lacks in the views of the parts' cameras."""

    def __init__(self, merged: Gaussians, centers: NDArray[np.float64]) -> None:
        """`centers` [C, 3]: positions of cameras."""
        k = np.arange(DIRECTIONS) + 0.5
        z, turn = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
        ring = np.sqrt(1 - z * z)
        self._directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
        self._nearest = KDTree(self._directions)
        self._merged, self._center = merged, centers.mean(0)
        self._radius = FAR * max(float(np.linalg.norm(centers - self._center, axis=1).max()), 1e-3)
        self._weight, self._sum = np.zeros(DIRECTIONS), np.zeros((DIRECTIONS, 3))

    def look(self, part: Gaussians, cameras: Sequence[Camera]) -> None:
        """Compare the merged scene with a whole part, in views of that part's cameras."""
        for camera in map(_small, cameras[:: -(-len(cameras) // CAMERAS) or 1]):
            image, _ = _render(part, camera)
            lit, alpha = _render(self._merged, camera)
            rows = self._nearest.query(_rays(camera))[1]
            # Least squares: the dome shines through where the merged scene lets it, lit + (1 - alpha) d.
            hole = 1 - alpha
            self._weight += np.bincount(rows, hole * hole, DIRECTIONS)
            for c in range(3):
                self._sum[:, c] += np.bincount(rows, hole * (image[:, c] - lit[:, c]), DIRECTIONS)

    def gaussians(self, sh_degree: int) -> Gaussians:
        """The directions in which some view saw through the merged scene, as Gaussians without harmonics."""
        seen = self._weight >= LEAST
        colors = (self._sum[seen] / self._weight[seen, None]).clip(0, 1)
        n = len(colors)
        means = self._center + self._radius * self._directions[seen]
        apart = np.sqrt(4 * np.pi / DIRECTIONS) * self._radius
        return Gaussians(
            means=torch.from_numpy(means).float(),
            scales=torch.full((n, 3), float(np.log(WIDTH * apart))),
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            opacities=torch.full((n,), float(np.log(OPACITY / (1 - OPACITY)))),
            sh0=torch.from_numpy((colors - 0.5) / SH_C0).float()[:, None],
            shN=torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3),
        )


def _small(camera: Camera) -> Camera:
    factor = min(1.0, SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    return resized_camera(camera, width, height)


def _rays(camera: Camera) -> NDArray[np.float64]:
    """The direction of each pixel, [H W, 3], unit, world."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = unproject(camera, pixels, np.ones(len(pixels))) - camera.center
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _render(gaussians: Gaussians, camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Colours [H W, 3] in front of black, and alphas [H W]."""
    harmonics = torch.cat([gaussians.sh0, gaussians.shN], dim=1)
    image, alpha = composited(gaussians, camera, harmonics, gaussians.sh_degree)
    return image.double().numpy().reshape(-1, 3), alpha.double().numpy().reshape(-1)
