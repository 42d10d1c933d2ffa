"""Which rays make up a photo: along a camera's path, or through a lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.scenes.room.shading import encode, render_light, to_bytes
from benchmarks.scenes.shake import exposure_times, path_points
from hqgs.photos.formation import GOLDEN
from hqgs.scene.scene import Camera

Floats = NDArray[np.float64]


class Exposure(NamedTuple):
    """A photo as the mean of samples: the ray of `cameras[s]` through each pixel's corner + `jitter[s]`."""

    cameras: Sequence[Camera]  # S
    jitter: Floats  # [S, 2], x and y in the unit square


def render_exposure(exposure: Exposure, threads: int | None = None) -> NDArray[np.uint8]:
    """Photo of the embedded scene, [H, W, 3] sRGB: the mean of an exposure's samples in linear light.

    The camera's curve comes last: it rolls off the highlights and encodes sRGB. `threads` as in
    `render_view`.
    """
    first = exposure.cameras[0]
    light = np.zeros((first.height, first.width, 3), np.float32)
    for camera, offset in zip(exposure.cameras, exposure.jitter, strict=True):
        light += render_light(camera, offset[None], threads)
    light /= np.float32(len(exposure.jitter))
    return to_bytes(encode(light))


def shaken(camera: Camera, knots: Floats, count: int) -> Exposure:
    """The mean over `count` equal parts of an exposure during which the camera moves; see `path_viewmats`."""
    viewmats = path_viewmats(camera.viewmat, knots, exposure_times(count))
    moved = [Camera(camera.width, camera.height, camera.K, viewmat) for viewmat in viewmats]
    return Exposure(moved, spread(count))


def through_lens(camera: Camera, aperture: float, focus: float, count: int) -> Exposure:
    """Through a thin lens of radius `aperture` (world units) that is sharp at view-space z = `focus`.

    A point at depth d becomes a disc of radius fx aperture |1/d - 1/focus| px: the mean over `count`
    pinholes, a sunflower on the lens, each with the principal point that keeps the plane in focus where it
    is.
    """
    k = np.arange(count)
    radii, angles = aperture * np.sqrt((k + 0.5) / count), GOLDEN * k
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1)
    pinholes = []
    for x, y in points - points.mean(axis=0):  # a sunflower of few seeds is off its middle
        viewmat, K = camera.viewmat.copy(), camera.K.copy()
        viewmat[:2, 3] -= x, y
        K[0, 2] += K[0, 0] * x / focus
        K[1, 2] += K[1, 1] * y / focus
        pinholes.append(Camera(camera.width, camera.height, K, viewmat))
    return Exposure(pinholes, spread(count))


def path_viewmats(viewmat: Floats, knots: Floats, times: Floats) -> Floats:
    """World-to-camera matrices [N, 4, 4] at `times` in [-1/2, 1/2] of a camera that moves around `viewmat`.

    The cubic through the four `knots` [4, 6] (`path_points`) gives a rotation vector w in radians and a
    translation v in world units, both in the frame of `viewmat`: a point p of that frame is then at
    exp([w]x) p + v.
    """
    points = path_points(knots, times)
    moves = np.tile(np.eye(4), (len(times), 1, 1))
    moves[:, :3, :3] = Rotation.from_rotvec(points[:, :3]).as_matrix()
    moves[:, :3, 3] = points[:, 3:]
    return moves @ viewmat


def spread(count: int) -> Floats:
    """Offsets [count, 2] of samples in a pixel, x and y, for samples that stand for times one after another.

    A Latin square: each axis holds `count` even places once. Of 256 seeded draws the one that goes least with
    time and least along a diagonal, without what is left of its drift over time: it would make the path
    longer or shorter by parts of a pixel. The mean is (1/2, 1/2).
    """
    rng, times = np.random.default_rng(0), exposure_times(count)
    draws = [np.stack([times, rng.permutation(times), rng.permutation(times)]) for _ in range(256)]
    _, x, y = min(draws, key=lambda draw: float(np.square(np.triu(draw @ draw.T, 1)).sum()))
    offsets = np.stack([x, y], -1)
    drift = times @ offsets / max(np.square(times).sum(), 1e-12)
    return 0.5 + offsets - times[:, None] * drift
