"""Cameras, views and scenes: what every loader produces and every consumer reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from hqgs.sfm import SfmReport  # which itself imports this module


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the OpenCV frame (x right, y down, z forward; see docs/conventions.md)."""

    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3], pixels, skew 0
    viewmat: NDArray[np.float64]  # [4, 4], world to camera

    @property
    def center(self) -> NDArray[np.float64]:
        """Camera centre in world coordinates, [3]."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]), dtype=np.float64)


@dataclass(frozen=True)
class View:
    """A photo with its camera.

    A photo from a file stays uint8 in memory. One that was degraded in memory is float32, where 1 is white
    and noise may leave [0, 1].
    """

    name: str
    camera: Camera
    image: NDArray[np.uint8] | NDArray[np.float32]  # [H, W, 3] sRGB, the camera's size
    mask: NDArray[np.bool_] | None = None  # [H, W], True where the photo counts; None: everywhere
    low: NDArray[np.float32] | None = None  # [h, w, 3]: a low-resolution photo before `image` enlarged it


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


def as_floats(photo: NDArray[np.uint8] | NDArray[np.float32]) -> NDArray[np.float32]:
    """A copy of a photo with white at 1."""
    return np.divide(photo, 255 if photo.dtype == np.uint8 else 1, dtype=np.float32)


@dataclass(frozen=True)
class Tracks:
    """How the photos bear out the points of a COLMAP model."""

    length: float  # photos that see a point, mean
    error: float  # px, mean distance between a point and where the photos see it


@dataclass(frozen=True)
class Scene:
    """Training views, held-out views and the sparse points that initialise the Gaussians."""

    name: str
    train: list[View]
    test: list[View]
    points: NDArray[np.float32]  # [P, 3], world
    point_colors: NDArray[np.uint8]  # [P, 3]
    source: str  # the format it was read from: "colmap", "llff", "transforms", "embedded"
    notes: list[str] = field(default_factory=list)  # what a reader of the report should know
    tracks: Tracks | None = None  # of the points, px of the views; None: its files do not tell
    seen: dict[str, NDArray[np.intp]] | None = None  # rows of the points that each photo shows; None as above
    sfm: SfmReport | None = None  # how poses and points differ from its files'; None: they are those

    @property
    def extent(self) -> float:
        """Radius of the camera positions: 1.1 max |c - mean(c)|, or 1 for a single camera."""
        centers = np.stack([v.camera.center for v in self.train])
        radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
        return 1.1 * radius if radius > 0 else 1.0

    @property
    def reach(self) -> float:
        """The extent, or the median depth of the points before the training views where that is larger.

        Photos taken side by side may show things that are many times farther away than the cameras are apart.
        """
        points, depths = self.points.astype(np.float64), []
        for view in self.train:
            depth = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
            depths.append(depth[depth > 0])
        seen = np.concatenate(depths)
        return max(self.extent, float(np.median(seen))) if seen.size else self.extent
