"""More points to start from: between those of the reconstruction, along the photos' edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial import QhullError

from hqgs.model.consistency import Agreement
from hqgs.photos.edges import edge_magnitude
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import View

SMOOTH = 1.0  # px, standard deviation of the blur before the edges: noise has some in every pixel
FLAT = 0.2  # share of the points that all pixels alike get
LEAST = 3  # points of a view that span a surface

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]


def points_along_edges(
    views: Sequence[View],
    points: Points,
    seen: Mapping[str, NDArray[np.intp]],
    count: int,
    seed: int,
    agreement: Agreement | None = None,
) -> tuple[Points, Colors]:
    """About `count` points [M, 3] (world) under pixels of the photos, and those pixels' colours [M, 3].

    Each view gets an equal share. Pixels are drawn without repetition, most of them in proportion to the
    photo's edges (HQGS, equation of the edge map). The depth is that of the surface through the points of
    the reconstruction that the view sees: planes over the triangles between them (1 / depth is linear in
    the pixels of a plane), outside of all triangles the nearest point's. Views that see fewer than 3 points
    get none.

    Args:
        views: with cameras and photos; masked pixels are not drawn.
        points: [P, 3], world.
        seen: by the view's name, which rows of `points` it sees; a view that is not there sees none.
        count: at least 0.
        seed: of the draw. Each view has its own numbers, whatever the others are.
        agreement: of the same views: depths are moved to where other photos agree best, and points that they
            do not agree with are left out. Guessed depths are far off where views are far apart.
    """
    found, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    for k, view in enumerate(views):
        share = count * (k + 1) // len(views) - count * k // len(views)
        rows = seen.get(view.name)
        if rows is None or not share:
            continue
        pixels = _drawn(view, share, np.random.default_rng([seed, k]))
        depths = _depths(view, points[rows].astype(np.float64), pixels)
        if depths is None:
            continue
        if agreement is not None:
            depths, agreed = agreement.depths(k, pixels, depths)
            pixels, depths = pixels[agreed], depths[agreed]
        found.append(unproject(view.camera, pixels, depths).astype(np.float32))
        columns, lines = pixels.astype(np.intp).T
        colors.append(to_uint8(as_floats(view.image)[lines, columns]))
    return np.concatenate(found), np.concatenate(colors)


def _drawn(view: View, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Centres [M, 2] of pixels as x, y; M is `count`, or fewer where so many do not count."""
    photo = gaussian_filter(as_floats(view.image), (SMOOTH, SMOOTH, 0))
    mask = np.ones(photo.shape[:2], bool) if view.mask is None else view.mask
    edges = edge_magnitude(torch.from_numpy(photo), torch.from_numpy(mask)).sum(2).double().numpy()
    weights = np.where(mask, FLAT / max(mask.sum(), 1), 0.0)
    weights += (1 - FLAT) * edges / max(edges.sum(), np.finfo(float).tiny)
    weights = weights.ravel()
    count = min(count, int(np.count_nonzero(weights)))
    # The largest of u^(1 / w): a draw without repetition in proportion to w (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        keys = np.log(rng.random(weights.size)) / weights
    chosen = np.argsort(-keys, kind="stable")[:count]
    lines, columns = np.divmod(chosen, view.camera.width)
    return np.stack([columns, lines], 1) + 0.5


def _depths(
    view: View, points: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Depths [M] at `pixels` [M, 2] of the surface through points [P, 3]; None where there are too few."""
    where, depths = project(view.camera, points)
    front = depths > 0
    if np.count_nonzero(front) < LEAST:
        return None
    where, nearness = where[front], 1 / depths[front]
    nearest = NearestNDInterpolator(where, nearness)(pixels)
    try:
        surface = LinearNDInterpolator(where, nearness)(pixels)
    except QhullError:  # all on one line
        surface = np.full(len(pixels), np.nan)
    return 1 / np.where(np.isfinite(surface), surface, nearest)
