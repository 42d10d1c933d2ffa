"""Projection: the one place that takes points to pixels and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs._rust import NEAR_PLANE
from hqgs.photos.resize import Pixels, area_downscale
from hqgs.scene.scene import Camera, Scene, View


def unproject(
    camera: Camera, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points [M, 3], world, at view-space `depths` [M] behind `pixels` [M, 2], x and y."""
    # Written out: BLAS would start threads for this, which cost more than the work.
    R, K = camera.viewmat[:3, :3], camera.K
    x, y = (pixels[:, 0] - K[0, 2]) / K[0, 0] * depths, (pixels[:, 1] - K[1, 2]) / K[1, 1] * depths
    x, y, z = x - camera.viewmat[0, 3], y - camera.viewmat[1, 3], depths - camera.viewmat[2, 3]
    return np.stack([x * R[0, i] + y * R[1, i] + z * R[2, i] for i in range(3)], axis=1)


def project(camera: Camera, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels [M, 2], x and y, and view-space depths [M] of `points` [M, 3], world.

    Nothing is left out: pixels of points behind the camera mean nothing, and are not finite at depth 0.
    """
    V, K = camera.viewmat, camera.K
    # Written out: BLAS would start threads for this, which cost more than the work.
    x, y, depths = (sum(points[:, j] * V[i, j] for j in range(3)) + V[i, 3] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([x * K[0, 0] / depths + K[0, 2], y * K[1, 1] / depths + K[1, 2]], axis=1), depths


def in_frame(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[M]: which of `points` [M, 3], world, lie before the camera and project into its picture."""
    return within(camera, *project(camera, points))


def within(camera: Camera, pixels: NDArray[np.float64], depths: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[M]: which of projected points lie before the camera and in its picture."""
    return (depths > 0) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(1)


def most_shown(
    points: int, seen: Mapping[str, NDArray[np.intp]], views: Sequence[View], count: int
) -> NDArray[np.intp]:
    """Rows, rising, of those of so many points that most of the views show, at most `count`."""
    shown = np.zeros(points, np.int64)
    for view in views:
        shown[seen.get(view.name, [])] += 1
    return np.sort(np.argsort(-shown, kind="stable")[:count])


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
    margin = 1.15  # of the half field of view: a Gaussian just outside the picture still reaches into it
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    seen = (
        (z > NEAR_PLANE)
        & (x.abs() * K[0, 0] < margin * camera.width / 2 * z)
        & (y.abs() * K[1, 1] < margin * camera.height / 2 * z)
    )
    return z, seen


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera with pixels of another size: the same picture in width x height px."""
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return Camera(width, height, K, camera.viewmat)


def shrunk_camera(camera: Camera, longest: int) -> Camera:
    """The same where no side is longer than `longest` px: the camera itself, or with larger pixels."""
    factor = max(1.0, max(camera.width, camera.height) / longest)
    return resized_camera(camera, *(max(1, round(side / factor)) for side in (camera.width, camera.height)))


def resized(view: View, width: int, height: int) -> View:
    """The view with photo, mask and camera at a smaller size, px."""
    camera = resized_camera(view.camera, width, height)
    if view.empty is not None:
        pixels = np.dstack([view.image, view.empty]).astype(np.uint8)
        both, mask = area_downscale(pixels, view.mask, width, height)
        image, empty = parts_of(both)
    else:
        (image, mask), empty = area_downscale(view.image, view.mask, width, height), None
    return replace(view, camera=camera, image=image, mask=mask, low=None, film=None, empty=empty)


def parts_of(pixels: Pixels) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Colours [H, W, 3] and how empty each pixel is [H, W], of both [H, W, 4]; None: nothing is empty."""
    found = pixels.astype(np.uint8)
    empty = np.ascontiguousarray(found[..., 3])
    return np.ascontiguousarray(found[..., :3]), empty if empty.any() else None


def shrunk(view: View, longest: int) -> View:
    """The view where no side is longer than `longest` px."""
    camera = shrunk_camera(view.camera, longest)
    return resized(view, camera.width, camera.height)
