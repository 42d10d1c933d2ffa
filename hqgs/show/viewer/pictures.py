"""What the page shows: the render from where its camera is, and a photo beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.model.formats.turned import matrices
from hqgs.scene.paths import view_matrix
from hqgs.scene.scene import Camera
from hqgs.show.frames import Activated, depth_picture, depth_range, grey, trust_picture
from hqgs.show.trust import Trust

STREAMED_SIDE = 2048  # px, at most
MOVED = 0.02  # radians, and of the distance: a camera nearer than that to a photo's sees the same
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Pose:
    """Where the camera of a page is, in the OpenCV frame."""

    R: NDArray[np.float64]  # [3, 3], the camera's axes as columns, in the world
    position: NDArray[np.float64]  # [3]
    fov: float  # vertical, radians
    aspect: float  # width / height

    @classmethod
    def of(cls, camera: Any) -> Pose | None:
        """Of viser's camera handle; None where its values are none that a camera has."""
        quat = np.asarray(camera.wxyz, np.float64)
        norm = float(np.linalg.norm(quat))
        position, fov = np.asarray(camera.position, np.float64), float(camera.fov)
        aspect = float(camera.image_width) / max(float(camera.image_height), 1.0)
        sound = np.isfinite([norm, fov, aspect]).all() and np.isfinite(position).all()
        if not (sound and norm > 1e-6 and 0.01 < fov < 3.1 and 0.05 < aspect < 20):
            return None
        return cls(matrices(quat[None])[0], position, fov, aspect)

    def camera(self, height: int) -> Camera:
        """The pinhole camera of a picture of that height."""
        height = min(max(height, 16), STREAMED_SIDE)
        width = min(max(round(height * self.aspect), 16), STREAMED_SIDE)
        focal = height / (2 * math.tan(self.fov / 2))
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        return Camera(width, height, K, view_matrix(self.R.T, self.position))


def shown(scene: Activated, camera: Camera, show: str, trust: Trust | None) -> Picture:
    """The picture of a camera, [H, W, 3]: "color", "depth", "alpha", or that of `trust`, if there is any."""
    if trust is not None:
        return trust_picture(trust.bound(camera))
    if show == "color":
        return scene.color(camera)
    depth, alpha = scene.depth(camera)
    if show == "depth":
        return depth_picture(depth, alpha, depth_range([(depth, alpha)]))
    return grey(alpha)


def same_view(camera: Camera, photo: Camera, reach: float) -> bool:
    """Whether a camera stands where a photo was taken; `reach`: the distance of what it shows."""
    turn = (np.trace(camera.viewmat[:3, :3] @ photo.viewmat[:3, :3].T) - 1) / 2
    near = float(np.linalg.norm(camera.center - photo.center)) < MOVED * reach
    return near and math.acos(min(max(float(turn), -1.0), 1.0)) < MOVED


def beside(picture: Picture, camera: Camera, photo: Picture, taken: Camera, share: float) -> Picture:
    """The picture with the photo over it, from the left up to `share` of the photo's width.

    Both cameras stand at one place: the photo is shifted and scaled to where its pixels belong. `photo` may
    be smaller than `taken`, its camera, says.
    """
    height, width = picture.shape[:2]
    scale = np.array([photo.shape[1] / taken.width, photo.shape[0] / taken.height])
    focal = np.array([taken.K[0, 0] / camera.K[0, 0], taken.K[1, 1] / camera.K[1, 1]])
    a = focal * scale
    b = (taken.K[:2, 2] - focal * camera.K[:2, 2]) * scale
    found = Image.fromarray(photo).transform(
        (width, height), Image.Transform.AFFINE, (a[0], 0, b[0], 0, a[1], b[1]), Image.Resampling.BILINEAR
    )
    x = (np.arange(width) + 0.5) * a[0] + b[0]
    y = (np.arange(height) + 0.5) * a[1] + b[1]
    columns = (x >= 0) & (x < share * photo.shape[1])
    rows = (y >= 0) & (y < photo.shape[0])
    out = picture.copy()
    over = rows[:, None] & columns[None]
    out[over] = np.asarray(found)[over]
    if columns.any() and share < 1:
        edge = int(np.flatnonzero(columns)[-1])
        out[rows, max(edge - 1, 0) : edge + 1] = 255
    return out
