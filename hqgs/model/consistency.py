"""Whether photos agree on where a pixel's surface is: a small sweep of its depth, judged by other photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import View

Floats = NDArray[np.float64]

SMOOTH = 1.0  # px, before patches are compared: of noise there is less then
REACH, STEPS = 1.6, 15  # of the nearness to either side of the guess, and how many are tried
PATCH, STRIDE = 2, 1.5  # samples to each side of a patch's middle, and px between them
NEIGHBOURS, AGREEING = 4, 2  # photos that are asked, and how many of them must agree
AGREED = 0.6  # correlation of the patches
FLAT = 1e-4  # variance of a patch, where 1 is white squared, below which it tells nothing


class Agreement:
    """The training photos as they are asked."""

    def __init__(self, views: Sequence[View], seen: Mapping[str, NDArray[np.intp]]) -> None:
        self._views = views
        self._grey = [
            gaussian_filter(as_floats(view.image).mean(2).astype(np.float64), SMOOTH) for view in views
        ]
        sets = [set(seen.get(view.name, np.zeros(0, np.intp)).tolist()) for view in views]
        self._shared = np.array([[len(a & b) for b in sets] for a in sets])
        np.fill_diagonal(self._shared, -1)

    def depths(self, number: int, pixels: Floats, guesses: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths [M] of pixels [M, 2] of a view near their guesses [M], and where other photos agree."""
        view = self._views[number]
        order = np.argsort(-self._shared[number], kind="stable")
        others = [int(k) for k in order[: min(NEIGHBOURS, len(order) - 1)]]
        if len(others) < AGREEING:
            return guesses, np.zeros(len(guesses), bool)
        steps = STRIDE * np.arange(-PATCH, PATCH + 1)
        offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)  # [S, 2]
        mine = self._sample(number, pixels[:, None] + offsets)
        spread = mine.var(1)
        mine = mine - mine.mean(1, keepdims=True)
        best, found = np.full(len(pixels), -1.0), guesses.copy()
        for factor in np.geomspace(1 / REACH, REACH, STEPS):
            depths = guesses * factor
            corners = np.repeat(depths, len(offsets))
            points = unproject(view.camera, (pixels[:, None] + offsets).reshape(-1, 2), corners)
            scores = []
            for k in others:
                where, front = project(self._views[k].camera, points)
                theirs = self._sample(k, where.reshape(len(pixels), -1, 2))
                theirs[(front <= 0).reshape(theirs.shape)] = np.nan
                theirs = theirs - theirs.mean(1, keepdims=True)
                norm = np.sqrt((mine**2).sum(1) * (theirs**2).sum(1))
                with np.errstate(invalid="ignore", divide="ignore"):
                    scores.append(np.nan_to_num((mine * theirs).sum(1) / norm, nan=-1.0))
            score = np.sort(scores, axis=0)[-AGREEING:].mean(0)
            better = score > best
            best, found = np.where(better, score, best), np.where(better, depths, found)
        return found, (best >= AGREED) & (spread > FLAT)

    def _sample(self, number: int, where: Floats) -> Floats:
        """The photo at [..., 2], x and y; NaN outside."""
        grey = self._grey[number]
        height, width = grey.shape[0], grey.shape[-1]
        x, y = where[..., 0] - 0.5, where[..., 1] - 0.5
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
        values = map_coordinates(grey, [np.where(inside, y, 0), np.where(inside, x, 0)], order=1)
        return np.where(inside, values, np.nan)
