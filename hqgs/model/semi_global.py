"""A depth for every pixel of a small photo: neighbours in the picture tell what other photos leave open.

Semi-global matching (Hirschmueller, PAMI 2008, equations 12 to 14) over four paths: the cost of a pixel at a
depth is how little the other photo that shows it best looks like it there. Another depth than the neighbour's
costs more, less so across an edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.model.consistency import SmallPhoto, pixel_map
from hqgs.model.constants import (
    ACROSS_EDGES,
    CONFIRMED,
    FLAT_PATCH,
    JUMP,
    LAYERS,
    SEEN_THROUGH,
    SLOPE,
    SMOOTH_AGREED,
    SMOOTH_FLAT,
    SMOOTH_PATCH,
    UNLIKE,
)
from hqgs.scene.geometry import project, unproject, within

Floats = NDArray[np.float64]
Grey = NDArray[np.float32]  # [h, w]
Volume = NDArray[np.float32]  # [h, w, LAYERS]


class DenseDepths:
    """Depths of all pixels of small photos, and which of them another photo confirms.

    None is confirmed where the photo shows something that no other shows there: smooth it is all the same.
    Masked pixels are compared with nothing, and bear nothing out.
    """

    def __init__(
        self,
        looks: Sequence[SmallPhoto],
        asked: Sequence[Sequence[int]],
        bounds: Sequence[Floats],
        on_stage: OnStage = silent,
    ) -> None:
        """`asked`: for each photo the numbers of those that it is compared with; `bounds`: its nearest and
        farthest depth [2]; `on_stage` hears of each."""
        self._looks = looks
        self._depths, self._scores = list[Floats](), list[Grey]()
        for k, look in enumerate(looks):
            depths, scores = depths_of(look, [looks[j] for j in asked[k]], bounds[k])
            self._depths.append(depths)
            self._scores.append(scores)
            on_stage(Stage("depths between first points", k + 1, len(looks)))
        self._confirmed: list[NDArray[np.bool_]] = []
        for number, depths in enumerate(self._depths):
            confirmed, _ = self._asked_back(number, _all_pixels(looks[number]), depths.ravel())
            _, variance = _mean_and_variance(looks[number].grey)
            told = (self._scores[number] > UNLIKE) | (variance < SMOOTH_FLAT)
            self._confirmed.append(confirmed.reshape(depths.shape) & told)

    def at(self, number: int, pixels: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Depths [M] of pixels [M, 2] of a photo's view, and which can stand: another photo confirms it, or
        it looks alike there and no confirmed surface lies behind it."""
        pixels = pixels * self._looks[number].scale
        cell = _cells(pixels, self._depths[number].shape)
        depths = self._depths[number][cell]
        _, seen_through = self._asked_back(number, pixels, depths, self._confirmed)
        alike = self._scores[number][cell] > SMOOTH_AGREED
        return depths, self._confirmed[number][cell] | (alike & ~seen_through)

    def _asked_back(
        self, number: int, pixels: Floats, depths: Floats, surfaces: Sequence[NDArray[np.bool_]] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether another photo has pixels [M, 2] at `depths` too, and whether one sees through them to a
        farther surface, of those that count."""
        look = self._looks[number]
        points = unproject(look.camera, pixels, depths)
        confirmed, seen_through = np.zeros(len(pixels), bool), np.zeros(len(pixels), bool)
        for other, there in enumerate(self._looks):
            if other == number:
                continue
            at, far = project(there.camera, points)
            rows = np.flatnonzero(within(there.camera, at, far))
            rows = rows[_counts(there, at[rows])]
            at, far = at[rows], far[rows]
            cell = _cells(at, self._depths[other].shape)
            theirs = self._depths[other][cell]
            back, _ = project(look.camera, unproject(there.camera, at, theirs))
            alike = np.linalg.norm(back - pixels[rows], axis=1) < CONFIRMED
            confirmed[rows] |= alike
            if surfaces is not None:
                seen_through[rows] |= ~alike & surfaces[other][cell] & (theirs > far * SEEN_THROUGH)
        return confirmed, seen_through


def depths_of(look: SmallPhoto, others: Sequence[SmallPhoto], bounds: Floats) -> tuple[Floats, Grey]:
    """Depths [h, w] of a photo's pixels between `bounds` (nearest, farthest), and how alike the other photo
    that shows each best looks there [h, w], -1 to 1."""
    nearness = np.linspace(1 / bounds[1], 1 / bounds[0], LAYERS)
    alike = _likeness(look, others, nearness)
    costs = _smoothed(1 - np.maximum(alike, 0), look.grey)
    layer = costs.argmin(2)[..., None]
    # The lowest point of a parabola through the best layer and its neighbours.
    inner = np.clip(layer, 1, LAYERS - 2)
    before, best, after = (np.take_along_axis(costs, inner + step, 2)[..., 0] for step in (-1, 0, 1))
    bend = np.maximum(before - 2 * best + after, np.finfo(np.float32).eps)
    place = inner[..., 0] + np.clip((before - after) / (2 * bend), -0.5, 0.5)
    depths = 1 / np.interp(place, np.arange(LAYERS), nearness)
    return depths, np.take_along_axis(alike, layer, 2)[..., 0]


def _likeness(look: SmallPhoto, others: Sequence[SmallPhoto], nearness: Floats) -> Volume:
    """The largest correlation of a patch of the photo with any other's, at each depth."""
    own = look.grey
    mean, variance = _mean_and_variance(own)
    x, y = _all_pixels(look).T.reshape(2, *own.shape)
    alike = np.full((LAYERS, *own.shape), -1, np.float32)
    for other in others:
        m = pixel_map(look.camera, other.camera)
        rows = [m[row, 0] * x + m[row, 1] * y + m[row, 2] for row in range(3)]
        high, wide = other.grey.shape
        for layer, near in enumerate(nearness):
            to_x, to_y, w = (rows[row] + m[row, 3] * near for row in range(3))
            front = w > 0
            to_x, to_y = to_x / np.where(front, w, 1), to_y / np.where(front, w, 1)
            shown = front & (to_x > 0.5) & (to_y > 0.5) & (to_x < wide - 0.5) & (to_y < high - 0.5)
            if other.mask is not None:
                pixels = np.stack([to_x, to_y], -1).reshape(-1, 2)
                shown &= _counts(other, np.where(shown.reshape(-1, 1), pixels, 0)).reshape(shown.shape)
            if not shown.any():
                continue
            at = [to_y - 0.5, to_x - 0.5]
            seen = np.asarray(map_coordinates(other.grey, at, order=1, mode="nearest"), np.float32)
            their_mean, their_variance = _mean_and_variance(seen)
            products = _blurred(own * seen) - mean * their_mean
            correlation = products / np.sqrt(variance * their_variance)
            np.maximum(alike[layer], np.where(shown, correlation, -1), out=alike[layer])
    if look.mask is not None:
        alike[:, ~look.mask] = -1
    return np.ascontiguousarray(alike.transpose(1, 2, 0))


def _mean_and_variance(grey: Grey) -> tuple[Grey, Grey]:
    mean = _blurred(grey)
    return mean, np.maximum(_blurred(grey * grey) - mean * mean, np.float32(FLAT_PATCH))


def _blurred(grey: Grey) -> Grey:
    return np.asarray(uniform_filter(grey, SMOOTH_PATCH), np.float32)


def _smoothed(costs: Volume, grey: Grey) -> Volume:
    """Costs summed along the four paths that lead to each pixel."""
    total = np.zeros_like(costs)
    for back in (slice(None), slice(None, None, -1)):
        total[back] += _along(costs[back], grey[back])
        total.swapaxes(0, 1)[back] += _along(costs.swapaxes(0, 1)[back], grey.T[back])
    return total


def _along(costs: Volume, grey: Grey) -> Volume:
    """The least cost of a path down the first axis that ends at each pixel and layer (equation 13)."""
    paths = np.empty_like(costs)
    paths[0] = before = costs[0]
    for row in range(1, len(costs)):
        step = np.abs(grey[row] - grey[row - 1])[:, None]
        jump = np.maximum(JUMP / (1 + ACROSS_EDGES * step), SLOPE)
        least = before.min(1, keepdims=True)
        beside = np.pad(before, ((0, 0), (1, 1)), constant_values=np.inf)
        beside = np.minimum(beside[:, :-2], beside[:, 2:]) + np.float32(SLOPE)
        paths[row] = costs[row] + np.minimum(np.minimum(before, beside), least + jump) - least
        before = paths[row]
    return paths


def _all_pixels(look: SmallPhoto) -> Floats:
    """Centres [h w, 2] of the pixels of a small photo."""
    high, wide = look.grey.shape
    return np.stack(np.meshgrid(np.arange(wide) + 0.5, np.arange(high) + 0.5), -1).reshape(-1, 2)


def _counts(look: SmallPhoto, pixels: Floats) -> NDArray[np.bool_]:
    """Which pixels [M, 2] no mask hides."""
    return np.ones(len(pixels), bool) if look.mask is None else look.mask[_cells(pixels, look.mask.shape)]


def _cells(pixels: Floats, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of pixels [M, 2] in a picture."""
    columns, rows = pixels.astype(np.intp).T
    return np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)
