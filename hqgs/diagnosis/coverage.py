"""Which of the scene's points the training views look at, and where in their photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.scene import View

LEAST_POINTS, MOST_POINTS = 100, 600  # looked at; they are spread over all of the scene's
CHECKS = 30_000_000  # of a point in two views; more views look at fewer points
MOST_TURNED = np.cos(np.deg2rad(45))  # between two rays to a point; beyond, it may be another side of a thing
COARSEST = 2.0  # times the size of a pixel at a point: a view that coarser shows it does not stand in
OUTLIERS = 0.02  # of the points, which may be anywhere
FAR = 4.0  # times the baseline that moves the median point by the parallax asked for


class Sight:
    """Points [P] in views [N]. What hides a point is not known: each view sees all that lies in its photo."""

    def __init__(self, views: Sequence[View], points: NDArray[np.float32]) -> None:
        """`points` [*, 3] in world units."""
        count = min(max(CHECKS // len(views) ** 2, LEAST_POINTS), MOST_POINTS, len(points))
        chosen = np.linspace(0, max(len(points) - 1, 0), count).astype(np.int64)
        world = points[chosen].astype(np.float64)
        Ks = np.stack([view.camera.K for view in views])
        sizes = np.array([(view.camera.width, view.camera.height) for view in views])[:, None]
        viewmats = np.stack([view.camera.viewmat for view in views])
        self._cameras = np.concatenate(
            [viewmats.reshape(-1, 16), Ks.reshape(-1, 9), sizes.reshape(-1, 2)], axis=1
        )
        self._centers = np.stack([view.camera.center for view in views])  # [N, 3]
        self._focals = np.sqrt(Ks[:, 0, 0] * Ks[:, 1, 1])  # [N], px
        local = world @ viewmats[:, :3, :3].swapaxes(1, 2) + viewmats[:, None, :3, 3]
        self._depths = local[..., 2]  # [N, P]
        front = self._depths > 0
        shares = local[..., :2] / np.where(front, self._depths, 1)[..., None]
        self._pixels = shares * Ks[:, None, [0, 1], [0, 1]] + Ks[:, None, :2, 2]  # [N, P, 2]
        self._inside = front & ((self._pixels >= 0) & (self._pixels < sizes)).all(-1)  # [N, P]
        rays = world - self._centers[:, None]
        lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
        self._rays = rays / np.where(lengths > 0, lengths, 1)

    def covered(self, view: int) -> NDArray[np.bool_]:
        """[N, p]: which views see each of the p points that `view` sees, from the same side and as finely.

        The row of `view` itself is False.
        """
        seen = self._inside[view]
        turned = np.einsum("npk,pk->np", self._rays[:, seen], self._rays[view, seen])
        fine = self._depths[view, seen] / self._focals[view]
        coarse = self._depths[:, seen] / self._focals[:, None] > COARSEST * fine
        covered = self._inside[:, seen] & (turned >= MOST_TURNED) & ~coarse
        covered[view] = False
        return covered

    def same_place(
        self, view: int, others: NDArray[np.int64], most: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Those of `others` whose photos show the points that `view` sees within `most` px of where it does.

        Returns their indices and how far off they are: the largest distance of a point in px, but for a few
        outliers. A view that sees no point has only views of the very same camera at its place.
        """
        seen = self._inside[view]
        if not seen.any():
            same = others[(self._cameras[others] == self._cameras[view]).all(1)]
            return same, np.zeros(len(same))
        baseline = FAR * most * np.median(self._depths[view, seen]) / self._focals[view]
        others = others[np.linalg.norm(self._centers[others] - self._centers[view], axis=1) <= baseline]
        moved = np.linalg.norm(self._pixels[others][:, seen] - self._pixels[view, seen], axis=-1)
        moved = np.where(self._depths[others][:, seen] > 0, moved, np.inf)
        parallax = np.quantile(moved, 1 - OUTLIERS, axis=1, method="higher")
        return others[parallax <= most], parallax[parallax <= most]
