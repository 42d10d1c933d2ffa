"""Whether photos agree on where a pixel's surface is: a sweep of its depth, judged by other photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hqgs import _rust
from hqgs.photos.pixels import as_floats
from hqgs.photos.resize import area_downscale
from hqgs.scene.scene import Camera, View

Floats = NDArray[np.float64]

LONGEST = 800  # px: larger photos are looked at in a smaller copy
SMOOTH = 1.0  # px, before patches are compared: of noise there is less then
NEIGHBOURS, AGREEING = 4, 2  # photos that are asked, and how many of them must agree
AGREED = 0.6  # correlation of the patches


class Agreement:
    """The training photos as they are asked."""

    def __init__(self, views: Sequence[View], seen: Mapping[str, NDArray[np.intp]]) -> None:
        """`seen`: by the view's name, which points it sees. Views that share most are asked first."""
        self._cameras, self._grey = [], []
        for view in views:
            camera, grey, _ = small(view)
            self._cameras.append(camera)
            self._grey.append(grey)
        self._scales = [scale(v.camera, c) for c, v in zip(self._cameras, views, strict=True)]
        sets = [set(seen.get(view.name, np.zeros(0, np.intp)).tolist()) for view in views]
        self._shared = np.array([[len(a & b) for b in sets] for a in sets])
        np.fill_diagonal(self._shared, -1)

    def depths(self, number: int, pixels: Floats, ranges: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths [M] of pixels [M, 2] of a view, each within its range [M, 2], and where others agree."""
        order = np.argsort(-self._shared[number], kind="stable")
        others = [int(k) for k in order[: min(NEIGHBOURS, len(order) - 1)]]
        if len(others) < AGREEING:
            return ranges[:, 0], np.zeros(len(ranges), bool)
        depths, scores = _rust.agreed_depths(
            self._grey[number],
            [self._grey[k] for k in others],
            np.stack([_map(self._cameras[number], self._cameras[k]) for k in others]),
            np.ascontiguousarray(pixels * self._scales[number]),
            np.ascontiguousarray(ranges),
            AGREEING,
        )
        return depths, scores >= AGREED


def small(view: View) -> tuple[Camera, NDArray[np.float32], NDArray[np.bool_] | None]:
    """The view as its photo is looked at: the camera, the photo [h, w] in one channel, smoothed, its mask."""
    camera, image, mask = view.camera, view.image, view.mask
    factor = max(camera.width, camera.height) / LONGEST
    if factor > 1:
        width, height = (max(1, round(side / factor)) for side in (camera.width, camera.height))
        image, mask = area_downscale(image, mask, width, height)
        K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
        camera = Camera(width, height, K, camera.viewmat)
    grey = as_floats(image).mean(2, dtype=np.float32)
    return camera, np.ascontiguousarray(gaussian_filter(grey, SMOOTH), np.float32), mask


def scale(camera: Camera, smaller: Camera) -> Floats:
    """What takes a pixel (x, y) of the one to that of the other, [2]."""
    return np.array([smaller.width / camera.width, smaller.height / camera.height])


def _map(first: Camera, second: Camera) -> Floats:
    """The matrix [3, 4] that takes (x, y, 1, 1 / depth) of a pixel of the first camera to the second's."""
    relative = second.viewmat @ np.linalg.inv(first.viewmat)
    turn = second.K @ relative[:3, :3] @ np.linalg.inv(first.K)
    return np.concatenate([turn, (second.K @ relative[:3, 3])[:, None]], 1)
