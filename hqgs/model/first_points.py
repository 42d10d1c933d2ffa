"""More points to start from: between those of the reconstruction, along the photos' edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel
from scipy.spatial import KDTree

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.model.consistency import Agreement, SmallPhoto
from hqgs.model.constants import AROUND, FLAT, LEAST_AROUND, WIDENED
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import View

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]


def points_along_edges(
    views: Sequence[View],
    points: Points,
    seen: Mapping[str, NDArray[np.intp]],
    count: int,
    seed: int,
    agreement: Agreement,
    on_stage: OnStage = silent,
) -> tuple[Points, Colors]:
    """About `count` points [M, 3] (world) under pixels of the photos, and those pixels' colours [M, 3].

    Each view gets an equal share. Pixels are drawn without repetition, most of them in proportion to the
    photo's edges. Their depths are sought around those of the nearest points that the view sees, where other
    photos agree best. Views that see fewer than 3 points get none.

    Args:
        views: with cameras and photos; masked pixels are not drawn.
        points: [P, 3], world.
        seen: by the view's name, which rows of `points` it sees; a view that is not there sees none.
        count: at least 0.
        seed: of the draw. Each view has its own numbers, whatever the others are.
        agreement: of the same views: how they are looked at; it tells the depths, and points that it does
            not find are left out.
        on_stage: hears of each view.
    """
    found, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    for k, view in enumerate(views):
        share = count * (k + 1) // len(views) - count * k // len(views)
        rows = seen.get(view.name)
        on_stage(Stage("first points, from photos", k + 1, len(views)))
        if rows is None or not share:
            continue
        pixels = _drawn(agreement.looks[k], share, np.random.default_rng([seed, k]))
        ranges = _ranges(view, points[rows].astype(np.float64), pixels)
        if ranges is None:
            continue
        depths, agreed = agreement.depths(k, pixels, ranges)
        pixels, depths = pixels[agreed], depths[agreed]
        found.append(unproject(view.camera, pixels, depths).astype(np.float32))
        columns, lines = pixels.astype(np.intp).T
        colors.append(to_uint8(as_floats(view.image[lines, columns])))
    return np.concatenate(found), np.concatenate(colors)


def _drawn(look: SmallPhoto, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Centres [M, 2] of pixels of the view as x, y; M is `count`, or fewer where so many do not count."""
    grey = look.grey
    mask = np.ones(grey.shape, bool) if look.mask is None else look.mask
    edges = np.where(mask, np.hypot(sobel(grey, 0), sobel(grey, 1)), 0.0)
    weights = np.where(mask, FLAT / max(mask.sum(), 1), 0.0)
    weights += (1 - FLAT) * edges / max(edges.sum(), np.finfo(float).tiny)
    weights = weights.ravel()
    count = min(count, int(np.count_nonzero(weights)))
    # The largest of u^(1 / w): a draw without repetition in proportion to w (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        keys = np.log(rng.random(weights.size)) / weights
    chosen = np.sort(np.argpartition(-keys, max(count - 1, 0))[:count])
    lines, columns = np.divmod(chosen, look.camera.width)
    return (np.stack([columns, lines], 1) + 0.5) / look.scale


def _ranges(
    view: View, points: NDArray[np.float64], pixels: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Between which depths [M, 2] the surface at `pixels` [M, 2] is sought, beside points [P, 3]; None where
    there are too few."""
    where, depths = project(view.camera, points)
    where, depths = where[depths > 0], depths[depths > 0]
    if len(depths) < LEAST_AROUND:
        return None
    _, nearest = KDTree(where).query(pixels, min(AROUND, len(depths)))
    around = depths[nearest]
    return np.stack([around.min(1) / WIDENED, around.max(1) * WIDENED], axis=1)
