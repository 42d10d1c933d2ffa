"""Whether photos were focused each in its own way: by how sharply they show the same points."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from hqgs.base.evenly import evenly
from hqgs.diagnosis.photo import Finding
from hqgs.photos.pixels import as_floats, luma
from hqgs.photos.resize import area_downscale
from hqgs.scene.constants import ENOUGH_SHOW, FEWEST_PHOTOS
from hqgs.scene.geometry import most_shown, project
from hqgs.scene.scene import Scene, View

Floats = NDArray[np.float64]
GOES_WITH_DEPTH, DIFFERS = 0.06, 0.4  # from these values of `focus_signs` on, photos differ in focus
MOST_PHOTOS, FOCUS_MOST_POINTS = 60, 4000  # that are looked at
# px: sigmas between which details lie, and the window around a point
FOCUS_FINE, FOCUS_COARSE, FOCUS_WINDOW = 0.8, 2.4, 9
FOCUS_LARGEST = 2000  # px: the longest side of what is looked at of a photo
FOCUS_DARK = 0.5 / 255  # contrast below which there is nothing to be sharp


def focus_signs(scene: Scene) -> tuple[float, float] | None:
    """How the sharpness of points (half the log ratio of the power of fine details to coarser ones) differs
    over training photos, standard deviations of what two halves of the points agree on: of the part that goes
    with nearness, at one standard deviation of it, and of the rest, `in_all`. None where photos are few,
    share few points, or it is not told which they show.

    What a point is like drops out, as all photos show it, and so does what comes with its distance. A lens
    that is focused nearer in one photo than in the next leaves 0.12 in the room that is built in, where
    other photos, clean, shaken or otherwise degraded, have 0.05 at most. Where some photos are out of focus
    as a whole, or blurred, `in_all` has 0.5; shake 0.1 to 0.3, noise or JPEG of some photos 0.1 to 0.2.
    """
    if scene.seen is None or len(scene.train) < FEWEST_PHOTOS:
        return None
    chosen = evenly(len(scene.train), MOST_PHOTOS)
    views = [scene.train[k] for k in chosen]
    points = most_shown(len(scene.points), scene.seen, views, FOCUS_MOST_POINTS)
    sharp, depths = (np.full((len(views), len(points)), np.nan) for _ in range(2))
    for k, view in enumerate(views):
        rows = np.flatnonzero(np.isin(points, scene.seen.get(view.name, [])))
        _look(view, scene.points[points[rows]].astype(np.float64), rows, sharp[k], depths[k])
    told = np.isfinite(sharp)
    keep = told.sum(0) >= ENOUGH_SHOW
    if told[:, keep].sum() < 40 * len(views):  # of each photo on average
        return None
    sharp, depths = sharp[:, keep], np.where(told, depths, np.nan)[:, keep]
    halves = [_of_photos(sharp[:, half::2], depths[:, half::2]) for half in (0, 1)]
    with_depth, in_all = (_agreed(first, second) for first, second in zip(*halves, strict=True))
    return with_depth, in_all


def _look(view: View, points: Floats, rows: NDArray[np.intp], sharp: Floats, depths: Floats) -> None:
    """Write the sharpness and the log depth of `points`, which have these `rows`, where the photo tells."""
    if not len(rows):
        return
    where, depth = project(view.camera, points)
    height, width = view.image.shape[:2]
    border = FOCUS_WINDOW // 2
    inside = (depth > 0) & (where > border).all(1) & (where < [width - border, height - border]).all(1)
    rows, places = rows[inside], (where[inside] - 0.5).T[::-1]
    grey = luma(as_floats(view.image)).astype(np.float32)
    if (factor := max(height, width) / FOCUS_LARGEST) > 1:
        small = round(width / factor), round(height / factor)
        grey = area_downscale(np.ascontiguousarray(grey[..., None]), None, *small)[0][..., 0]
        scale = np.array([small[1] / height, small[0] / width])[:, None]
        places = (places + 0.5) * scale - 0.5
    fine, coarse = gaussian_filter(grey, FOCUS_FINE), gaussian_filter(grey, FOCUS_COARSE)
    power = [
        map_coordinates(uniform_filter(np.square(part), FOCUS_WINDOW), places, order=1, mode="nearest")
        for part in (grey - fine, fine - coarse)
    ]
    ratio = (power[0].astype(np.float64) + FOCUS_DARK**2) / (power[1] + FOCUS_DARK**2)
    sharp[rows], depths[rows] = 0.5 * np.log(ratio), np.log(depth[inside])


def _of_photos(sharp: Floats, depths: Floats) -> tuple[Floats, Floats]:
    """For each photo, the share of its points' sharpness that goes with nearness, and the rest, [N] each."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of points or photos that tell nothing
        # that count; the photo's median depth has 1
        near = np.exp(np.nanmedian(depths, axis=1, keepdims=True) - depths).clip(*(0.2, 3.0))
        near -= np.nanmean(near, axis=1, keepdims=True)
        farther = depths - np.nanmean(depths, axis=0)
        squares = np.nansum(near**2, axis=1)
        slope, rest = np.zeros(len(sharp)), np.zeros(len(sharp))
        with_distance = 0.0
        for _ in range(30):  # medians of photos and points in turn
            told = sharp - with_distance * farther
            own = np.nanmedian(told - rest[:, None] - slope[:, None] * near, axis=0)
            left = told - own
            rest = np.nan_to_num(np.nanmedian(left - slope[:, None] * near, axis=1))
            off = (left - rest[:, None]).clip(-1, 1)
            # added to the sum of squares of a photo's nearness: few points tell no slope
            slope = np.nansum(near * off, axis=1) / (squares + 0.25)
            slope, rest = slope - np.median(slope), rest - np.median(rest)
            off = sharp - own - rest[:, None] - slope[:, None] * near
            with_distance = float(np.nansum(off * farther) / max(np.nansum(farther**2), 1e-9))
        spread = np.nan_to_num(np.nanstd(near, axis=1))
    return slope * spread, rest


def _agreed(first: Floats, second: Floats) -> float:
    """The standard deviation of what two estimates have in common."""
    common = np.mean((first - first.mean()) * (second - second.mean()))
    return float(np.sqrt(max(common, 0.0)))


def focus_finding(scene: Scene, shaken: bool) -> Finding:
    """`shaken`: photos then differ in sharpness as a whole, whatever their focus."""
    signs = focus_signs(scene)
    if signs is None:
        return Finding("focus", "not measured: the photos share too few points")
    with_depth, in_all = signs
    needed = with_depth >= GOES_WITH_DEPTH or (in_all >= DIFFERS and not shaken)
    reason = (
        f"the sharpness of points differs from photo to photo by {with_depth:.2f} with their distance, "
        f"by {in_all:.2f} in all"
    )
    if not needed:
        reason += f" (needed from {GOES_WITH_DEPTH:g} or {DIFFERS:g}, in the logarithm of contrast)"
    return Finding("focus", reason, "focus" if needed else None, with_depth)
