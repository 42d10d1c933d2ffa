"""Normalised patches of a model's points in the photos that see them, and where they fit best."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import csr_array

from hqgs._rust import get_num_threads
from hqgs.base.machine import AT_ONCE
from hqgs.base.threads import of_each
from hqgs.photos.pixels import grey
from hqgs.scene.sfm.refine.tracks import Floats, Tracks, seen_at

HALF = 6  # nodes of a patch to each side of its middle
PATCH_SIDE = 1000  # px, of these photos
PATCH_STEPS, STILL = 5, 0.05  # of Gauss-Newton, at most; nodes, the usual step after which none follows
REACH = 3.0  # px that an observation may move
SURE, NEW = 0.6, 0.7  # correlation with the others' mean, of what stays; of what no feature told of
UNLIKE = 0.3  # of a photo's observations that are sure: with fewer, patches tell nothing of it
PATCH_PHOTOS = 12  # that a point is looked for in, beside those whose features show it
FRONTAL = 0.8  # cosine of the angle between a patch's normal and a new ray, least
COARSER = 2.0  # px of a photo in which a point is looked for, in px of the finest that shows it, most


def read_photos(folder: Path, names: Sequence[str]) -> list[NDArray[np.float32]]:
    """Photos of a folder, gray and smoothed, their longest side at most PATCH_SIDE px."""

    def read(name: str) -> NDArray[np.float32]:
        with Image.open(folder / name) as image:
            gray = grey(image)
            share = PATCH_SIDE / max(gray.size)
            if share < 1:
                size = max(1, round(gray.width * share)), max(1, round(gray.height * share))
                gray = gray.resize(size, Image.Resampling.BOX)
            values = np.asarray(gray, np.float32)
        return np.asarray(gaussian_filter(values, 1.0, mode="nearest"), np.float32)

    return list(of_each(read, names))


class PatchView:
    """A photo and its camera."""

    def __init__(self, model: pycolmap.Reconstruction, name: str, photo: NDArray[np.float32]) -> None:
        image = next(image for image in model.images.values() if image.name == name)
        self.photo: NDArray[np.float32] = photo
        self.pose: Any = image.cam_from_world()
        self.camera: Any = model.cameras[image.camera_id]
        self.center: Floats = image.projection_center()
        self.size: Floats = np.array([self.camera.width, self.camera.height], np.float64)
        self.ratio: Floats = np.array(photo.shape[::-1], np.float64) / self.size
        self.focal: float = self.camera.mean_focal_length() * float(self.ratio[0])  # px of `photo`

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Where points [N, 3] are in the photo [N, 2], and their depths [N]; behind it nowhere."""
        at, depths = seen_at(self.pose, self.camera, points)
        return np.where(np.isfinite(at), at, -1e6), depths

    def sample(self, at: Floats) -> NDArray[np.float32]:
        """Values [O, N] at pixels [O, 2, N] of the camera, whose middles lie at halves."""
        x, y = at[:, 0] * self.ratio[0] - 0.5, at[:, 1] * self.ratio[1] - 0.5
        return np.asarray(
            map_coordinates(self.photo, [y, x], np.float32, order=1, mode="nearest"), np.float32
        )


def axes_of(views: list[PatchView], tracks: Tracks) -> Floats:
    """Axes [P, 3, 2] of each point's patch, a node long: square to the mean ray, a pixel wide."""
    rays = np.zeros((len(tracks.points), 3))
    sizes = np.full(len(tracks.points), np.inf)
    centers = np.array([view.center for view in views])
    focals = np.array([view.focal for view in views])
    apart = tracks.points[tracks.point] - centers[tracks.view]
    far = np.linalg.norm(apart, axis=1)
    for axis in range(3):
        rays[:, axis] = np.bincount(tracks.point, apart[:, axis] / far, len(tracks.points))
    np.minimum.at(sizes, tracks.point, far / focals[tracks.view])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    other = np.where(np.abs(rays[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(rays, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=2) * sizes[:, None, None]


_GRID = np.stack(np.meshgrid(*[np.arange(-HALF, HALF + 1.0)] * 2, indexing="xy"), -1).reshape(-1, 2)  # x, y
_WEIGHTS = np.exp(-np.square(_GRID).sum(1) / (2 * 3.5**2))  # sigma of 3.5 nodes
_WEIGHTS = (_WEIGHTS / _WEIGHTS.sum()).astype(np.float32)


def _laid(views: list[PatchView], tracks: Tracks, axes: Floats) -> tuple[Floats, Floats]:
    """In px of the cameras, a node of each observation's patch [O, 2, 2] and where its point is [O, 2]."""
    turns, middles = np.zeros((len(tracks.view), 2, 2)), np.zeros((len(tracks.view), 2))
    for k, view in enumerate(views):
        mine = np.flatnonzero(tracks.view == k)
        points, ways = tracks.points[tracks.point[mine]], axes[tracks.point[mine]]
        middles[mine], _ = view.project(points)
        for axis in range(2):
            turns[mine, :, axis] = view.project(points + ways[:, :, axis])[0] - middles[mine]
    return turns, middles


def _patches(
    views: list[PatchView], tracks: Tracks, turns: Floats, at: Floats, pool: Executor
) -> NDArray[np.float32]:
    """Normalised patches [O, N] around `at` [O, 2]: weighted mean 0 and sum of squares 1."""
    values = np.zeros((len(at), len(_GRID)), np.float32)

    def take(k: int) -> None:
        mine = np.flatnonzero(tracks.view == k)
        values[mine] = _normalised(views[k].sample(at[mine, :, None] + turns[mine] @ _GRID.T))

    list(pool.map(take, range(len(views))))
    return values


def _normalised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    values = values - (values * _WEIGHTS).sum(1, keepdims=True)
    return values / np.maximum(np.sqrt((np.square(values) * _WEIGHTS).sum(1, keepdims=True)), 1e-6)


def _inside(views: list[PatchView], tracks: Tracks, turns: Floats, at: Floats) -> NDArray[np.bool_]:
    """Whether the middle half of each observation's patch lies in its photo, [O]; the rest counts little."""
    sizes = np.array([view.size for view in views])[tracks.view]
    reach = HALF / 2 * np.abs(turns).sum(axis=2)
    return ((at - reach >= 0) & (at + reach <= sizes)).all(axis=1)


def _means(patches: NDArray[np.float32], tracks: Tracks, counted: NDArray[np.bool_]) -> NDArray[np.float32]:
    """For each observation the mean patch [O, N] of the point's other photos that are counted, normalised."""
    rows = np.flatnonzero(counted)
    of_point = csr_array(
        (np.ones(len(rows), np.float32), (tracks.point[rows], rows)), (len(tracks.points), len(patches))
    )
    return _normalised((of_point @ patches)[tracks.point] - patches * counted[:, None])


def _slopes(patches: NDArray[np.float32], mean: NDArray[np.float32]) -> Floats:
    """Of patches [O, N] and those that they are laid against, weighted sums over the nodes [O, 5]: of the
    latter's slopes squared (xx, xy, yy), and times what the two differ by."""
    grid = mean.reshape(-1, 2 * HALF + 1, 2 * HALF + 1)
    x, y = (np.asarray(np.gradient(grid, axis=axis)).reshape(mean.shape) for axis in (2, 1))
    off, wx, wy = mean - patches, x * _WEIGHTS, y * _WEIGHTS
    pairs = ((wx, x), (wx, y), (wy, y), (wx, off), (wy, off))
    return np.stack([(a * b).sum(1, dtype=np.float64) for a, b in pairs], 1)


def fitted(
    views: list[PatchView], tracks: Tracks, new: NDArray[np.bool_]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Where the patches of observations agree best with those of their points' other photos [O, 2], and which
    of them are sure [O]. New ones do not count in the means.
    """
    turns, middles = _laid(views, tracks, axes_of(views, tracks))
    usable = _inside(views, tracks, turns, tracks.xy) & (middles > -1e5).all(axis=1)
    at, counted = tracks.xy, usable & ~new
    reach = REACH / np.array([view.ratio[0] for view in views])[tracks.view, None]
    parts = [slice(start, start + 4096) for start in range(0, max(1, len(at)), 4096)]
    with ThreadPoolExecutor(get_num_threads()) as pool:
        for _ in range(PATCH_STEPS):
            patches = _patches(views, tracks, turns, at, pool)
            mean = _means(patches, tracks, counted)
            sums = list(pool.map(_slopes, (patches[part] for part in parts), (mean[part] for part in parts)))
            xx, xy, yy, xo, yo = np.concatenate(sums).T
            xx, yy = xx + 1e-6, yy + 1e-6
            step = np.stack([yy * xo - xy * yo, xx * yo - xy * xo], 1) / (xx * yy - xy**2)[:, None]
            step /= np.maximum(np.abs(step).max(1, keepdims=True), 1)  # a node at most
            at = tracks.xy + np.clip(at + np.einsum("oij,oj->oi", turns, step) - tracks.xy, -reach, reach)
            if 2 * (np.linalg.norm(step[usable], axis=1) > STILL).sum() < usable.sum():
                break
        patches = _patches(views, tracks, turns, at, pool)
    alike = (patches * _means(patches, tracks, counted) * _WEIGHTS).sum(1)
    near = (np.abs(at - tracks.xy) < reach).all(1)
    return at, usable & near & (alike >= np.where(new, NEW, SURE))


def aligned(
    views: list[PatchView], tracks: Tracks, new: NDArray[np.bool_]
) -> tuple[Tracks, NDArray[np.bool_], NDArray[np.bool_]]:
    """Observations moved to where they are `fitted`, which of them are sure [O], and which photos look unlike
    the others [V].

    A photo of which few are sure is unlike: its own stay where features had them.
    """
    at, sure = fitted(views, tracks, new)
    known = np.bincount(tracks.view[~new], minlength=len(views))
    unlike = np.bincount(tracks.view[~new & sure], minlength=len(views)) < UNLIKE * known
    stay = unlike[tracks.view]
    at = np.where(stay[:, None], tracks.xy, at)
    return replace(tracks, xy=at), np.where(stay, ~new, sure), unlike


def _candidates(
    views: list[PatchView], tracks: Tracks, normals: Floats, sizes: Floats, first: int, end: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Photos [O] that should show points from row `first` to `end`, which points [O], and where [O, 2]."""
    points, normals, sizes = tracks.points[first:end], normals[first:end], sizes[first:end]
    may, places = np.zeros((len(views), len(points)), bool), []
    for k, view in enumerate(views):
        at, depths = view.project(points)
        rays = points - view.center
        far = np.linalg.norm(rays, axis=1)
        frontal = np.abs((rays * normals).sum(1)) > FRONTAL * far
        inside = ((at >= HALF / view.ratio) & (at <= view.size - HALF / view.ratio)).all(1)
        may[k] = inside & (depths > 0) & frontal & (far / view.focal < COARSER * sizes)
        places.append(at)
    own = (tracks.point >= first) & (tracks.point < end)
    may[tracks.view[own], tracks.point[own] - first] = False
    # Of each point's candidates some that are spread over the photos.
    rank, count = np.cumsum(may, axis=0) - 1, may.sum(axis=0)
    share = np.minimum(1, PATCH_PHOTOS / np.maximum(count, 1))
    may &= np.floor((rank + 1) * share) > np.floor(rank * share)
    view, point = np.nonzero(may)
    return view, point + first, np.array(places)[view, point]


def widened(views: list[PatchView], tracks: Tracks) -> tuple[Tracks, NDArray[np.bool_]]:
    """Also observations that photos should have of points, PATCH_PHOTOS of each; and which are new [O]."""
    axes = axes_of(views, tracks)
    normals = np.cross(axes[:, :, 0], axes[:, :, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sizes = np.linalg.norm(axes[:, :, 0], axis=1)
    step = max(1, AT_ONCE // len(views))  # points at a time
    firsts = range(0, max(1, len(tracks.points)), step)
    found = [_candidates(views, tracks, normals, sizes, first, first + step) for first in firsts]
    view, point, xy = (np.concatenate(values) for values in zip(*found, strict=True))
    order = np.lexsort((point, view))
    joined = tracks.more(view[order], point[order], xy[order])
    return joined, np.arange(len(joined.view)) >= len(tracks.view)
