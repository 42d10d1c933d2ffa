"""Whether photos agree on where a pixel's surface is: a sweep of its depth, judged by other photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from hqgs import _rust
from hqgs._rust import get_num_threads
from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import shrunk
from hqgs.scene.scene import Camera, View

AGREEING, AGREED = 2, 0.6  # photos that must agree, and the correlation of patches
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SmallPhoto:
    """A photo as it is looked at: small, in one channel, smoothed."""

    camera: Camera  # of this size
    grey: NDArray[np.float32]  # [h, w]
    mask: NDArray[np.bool_] | None  # [h, w], as that of a view
    scale: Floats  # [2]: what takes a pixel (x, y) of the view to one of this photo

    @classmethod
    def of(cls, view: View, longest: int = 800) -> SmallPhoto:
        whole = view.camera
        view = shrunk(view, longest)
        camera, grey = view.camera, as_floats(view.image).mean(2, dtype=np.float32)
        smooth = np.ascontiguousarray(gaussian_filter(grey, 1.0), np.float32)
        scale = np.array([camera.width / whole.width, camera.height / whole.height])
        return cls(camera, smooth, view.mask, scale)


class Agreement:
    """The training photos as they are asked."""

    def __init__(self, views: Sequence[View], seen: Mapping[str, NDArray[np.intp]]) -> None:
        """`seen`: by the view's name, which points it sees. Views that share most are asked first, but of
        those from one place, as of a burst, one."""
        with ThreadPoolExecutor(get_num_threads()) as pool:
            self.looks: list[SmallPhoto] = list(pool.map(SmallPhoto.of, views))
        rows = [np.unique(seen.get(view.name, np.zeros(0, np.intp))) for view in views]
        ends = np.cumsum([0, *map(len, rows)])
        points = 1 + max((int(some[-1]) for some in rows if len(some)), default=0)
        sees = csr_array((np.ones(ends[-1], np.intp), np.concatenate(rows), ends), (len(views), points))
        self._shared: NDArray[np.intp] = (sees @ sees.T).toarray()
        np.fill_diagonal(self._shared, -1)
        centers = np.stack([view.camera.center for view in views])
        far = cdist(centers, centers)
        self._apart: NDArray[np.bool_] = far > 0.01 * np.median(far)  # nearer ones are from one place

    def asked(self, number: int, most: int = 4) -> list[int]:
        """Numbers of the photos that share most points with a view, at most so many, and apart from it."""
        order = [int(k) for k in np.argsort(-self._shared[number], kind="stable") if self._apart[number, k]]
        first = list[int]()
        for k in order:
            if len(first) == most:
                break
            if self._apart[k, first].all():
                first.append(k)
        return (first + [k for k in order if k not in first])[:most]

    def depths(
        self, number: int, pixels: Floats, ranges: Floats, others: Sequence[int] | None = None
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths [M] of pixels [M, 2] of a view, each within its range [M, 2], and where others agree.

        `others`: who is asked, None: `asked`.
        """
        others = self.asked(number) if others is None else others
        if len(others) < AGREEING:
            return ranges[:, 0], np.zeros(len(ranges), bool)
        depths, scores = self._swept(number, pixels, ranges, others, AGREEING)
        return depths, scores >= AGREED

    def depths_by(self, number: int, pixels: Floats, ranges: Floats, other: int) -> tuple[Floats, Floats]:
        """Depths [M] as `depths` has them by one other photo alone, and the correlations [M]; -1: none."""
        return self._swept(number, pixels, ranges, [other], 1)

    def _swept(
        self, number: int, pixels: Floats, ranges: Floats, others: Sequence[int], agreeing: int
    ) -> tuple[Floats, Floats]:
        look = self.looks[number]
        return _rust.agreed_depths(
            look.grey,
            [self.looks[k].grey for k in others],
            np.stack([pixel_map(look.camera, self.looks[k].camera) for k in others]),
            np.ascontiguousarray(pixels * look.scale),
            np.ascontiguousarray(ranges),
            agreeing,
        )


def pixel_map(first: Camera, second: Camera) -> Floats:
    """The matrix [3, 4] that takes (x, y, 1, 1 / depth) of a pixel of the first camera to the second's."""
    relative = second.viewmat @ np.linalg.inv(first.viewmat)
    turn = second.K @ relative[:3, :3] @ np.linalg.inv(first.K)
    return np.concatenate([turn, (second.K @ relative[:3, 3])[:, None]], 1)
