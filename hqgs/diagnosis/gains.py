"""The gain of each photo, from the colours in which the photos show the same points."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter
from scipy.special import logsumexp

from hqgs.base.elementary import on_grid
from hqgs.diagnosis.constants import (
    BRIGHT,
    GAINS_DARK,
    GAINS_DOUBT,
    GAINS_GRID,
    GAINS_LENGTHS,
    GAINS_WINDOW,
    MOST_VALUES,
    OPPONENTS,
    ROUNDS,
    SHARES,
)
from hqgs.photos.light import to_linear
from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import most_shown, project
from hqgs.scene.scene import Scene, View
from hqgs.scene.sfm.constants import JOINT

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SharedColors:
    """The light in which the training photos show points, where at least two of them tell it."""

    logs: Floats  # [N, P, 3], of the light of red, green and blue; NaN where a photo does not tell
    squares: Floats  # [N, P], r^2 where it shows them, see `hqgs.photos.look`; NaN too


def shared_colors(scene: Scene) -> SharedColors | None:
    """None where the scene does not tell which photos show which points, or a photo shares fewer than
    JOINT with others (dark and saturated ones do not count)."""
    if scene.seen is None or len(scene.train) < 3:
        return None
    chosen = _chosen_points(scene, scene.seen)
    colors = np.full((len(scene.train), len(chosen), 3), np.nan)
    squares = np.full(colors.shape[:2], np.nan)
    for k, view in enumerate(scene.train):
        rows = np.flatnonzero(np.isin(chosen, scene.seen.get(view.name, [])))
        if len(rows):
            points = scene.points[chosen[rows]].astype(np.float64)
            _note_colors(view, points, rows, colors[k], squares[k])
    told = np.isfinite(colors).all(2)
    told &= told.sum(0) >= 2
    if told.sum(1).min() < JOINT:
        return None
    with np.errstate(invalid="ignore"):
        logs = np.log(np.where(told[..., None], colors, np.nan))
    return SharedColors(logs, np.where(told, squares, np.nan))


def log_gains(scene: Scene, shared: SharedColors | None = None) -> Floats | None:
    """The logarithms of the training photos' gains of red, green and blue in linear light, [N, 3], of mean 0.

    Only what a photo does not share with those taken beside it: where the light changes along the way, or a
    film's exposure follows the picture, neighbours go together, and colours that depend on the direction
    hold that, and held-out photos have it too. It is told apart by the likelihood of a Gaussian process over
    places and directions with independent gains on top. `shared`: the scene's, where it is known; None where
    there are none.
    """
    shared = shared or shared_colors(scene)
    if shared is None:
        return None
    logs = shared.logs
    gains: Floats = np.zeros((len(scene.train), 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of points that no photo tells
        for _ in range(ROUNDS):
            own = np.nanmean(logs - gains[:, None], axis=0)
            gains = np.nanmedian(logs - own, axis=1)
            gains -= gains.mean(0)
    return _apart(scene.train, gains)


def _chosen_points(scene: Scene, seen: Mapping[str, NDArray[np.intp]]) -> NDArray[np.intp]:
    """Rows of the points to look at, rising: all, or where memory is short those that most photos show."""
    return most_shown(len(scene.points), seen, scene.train, MOST_VALUES // len(scene.train))


def _note_colors(view: View, points: Floats, rows: NDArray[np.intp], colors: Floats, squares: Floats) -> None:
    """Write the light of a photo at `points`, which have these `rows`, and their r^2; NaN where it does not
    tell."""
    camera = view.camera
    where, depths = project(camera, points)
    rows, where = rows[depths > 0], where[depths > 0]
    away = np.square(where - camera.K[:2, 2]).sum(1)
    squares[rows] = away * (4 / (camera.height**2 + camera.width**2))
    if view.image.dtype == np.uint8:  # 256 powers, not one for each value
        table = to_linear(as_floats(np.arange(256, dtype=np.uint8)).astype(np.float64))
        light = table[view.image.astype(np.uint8, copy=False)]
    else:
        light = to_linear(np.clip(view.image, 0, 1).astype(np.float64))
    for c in range(3):
        smooth = uniform_filter(light[..., c], GAINS_WINDOW, mode="nearest")
        found = map_coordinates(smooth, (where - 0.5).T[::-1], order=1, mode="nearest")
        colors[rows, c] = np.where((found > GAINS_DARK) & (found < BRIGHT), found, np.nan)


def _apart(views: Sequence[View], gains: Floats) -> Floats:
    """`gains` [N, 3] of mean 0 without what neighbours share: its mean over GAINS_LENGTHS and SHARES.

    Brightness and the two differences of colour are looked at apart, since a tint may drift where the
    exposure does not; the length is one for all three.
    """
    centers = np.stack([view.camera.center for view in views])
    ahead = np.stack([view.camera.viewmat[2, :3] for view in views])
    reach = float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) or 1.0
    squares = np.square((centers[:, None] - centers) / reach).sum(-1)
    squares += np.square(ahead[:, None] - ahead).sum(-1)
    parts = gains @ OPPONENTS.T
    apart = -0.5 * len(views) * np.log(np.square(parts).mean(0) + 1e-12)
    evidence, shared = [apart.sum() + GAINS_DOUBT], [np.zeros_like(gains)]
    for length in GAINS_LENGTHS:
        together = np.exp(-squares / (2 * length**2))
        likely, means = [apart], [np.zeros_like(gains)]
        for share in SHARES:
            covariance = share * together + (1 - share + 1e-4) * np.eye(len(views))
            values, vectors = np.linalg.eigh(covariance)
            seen = vectors.T @ parts
            energy = np.square(seen) / values[:, None]
            likely.append(-0.5 * (len(views) * np.log(energy.mean(0) + 1e-12) + np.log(values).sum()))
            means.append(share * together @ (vectors @ (seen / values[:, None])))
        total = np.asarray(logsumexp(likely, axis=0))
        evidence.append(total.sum() - 3 * math.log(len(likely)) - math.log(len(GAINS_LENGTHS)))
        shared.append((np.exp(likely - total)[:, None] * means).sum(0))
    weights = np.exp(np.array(evidence) - logsumexp(evidence))
    rest = gains - np.tensordot(weights, shared, 1) @ OPPONENTS
    rest = on_grid(rest, GAINS_GRID)
    return rest - rest.mean(0)
