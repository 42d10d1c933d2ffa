"""First points that photos find in each other: all over what at least two of them show.

Between points of a reconstruction depths are sought twice. What is found at first, and found back by other
photos, tells more closely where to look; so does it where no two others agree, and one alone must. What none
bears out gets, of few photos, the depth that lies smoothly between (`semi_global`), unless a surface speaks
against it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hqgs.base.stages import OnStage, Stage, silent
from hqgs.model.consistency import Agreement, SmallPhoto
from hqgs.model.constants import (
    ALONE,
    AROUND_KNOWN,
    ASKED_AGAIN,
    FOUND_BACK,
    SMOOTH_LONGEST,
    SMOOTH_PHOTOS,
    WIDENED,
)
from hqgs.model.first_points import (
    STAGE,
    Colors,
    Found,
    Points,
    Surfaces,
    drawn,
    first_look,
    gathered,
    shares,
)
from hqgs.model.semi_global import DenseDepths
from hqgs.scene.geometry import in_frame, project, unproject
from hqgs.scene.scene import View

Floats = NDArray[np.float64]


def points_found_back(
    views: Sequence[View],
    points: Points,
    seen: Mapping[str, NDArray[np.intp]],
    count: int,
    seed: int,
    agreement: Agreement,
    on_stage: OnStage = silent,
) -> tuple[Points, Colors, float]:
    """At most `count` points, as `points_along_edges` has them, and the share of a first look at so many
    pixels at which photos agree.

    A pixel counts where two others agree and one of them finds it back, or where one alone agrees much and
    finds it back: at the depth that it has there, within FOUND_BACK px. Of at most SMOOTH_PHOTOS photos the
    others count at the depth that lies smoothly between, where that can stand (`DenseDepths.at`).
    """
    surfaces = Surfaces(views, points, seen)
    each, looks = shares(count, len(views)), 2 * len(views)
    sure, agreeing = list[Found](), 0
    for k, pixels, depths in first_look(surfaces, each, seed, agreement):
        on_stage(Stage(STAGE, k + 1, looks))
        agreeing += len(depths)
        by_two = _found_back(agreement, surfaces, k, pixels, depths, agreement.asked(k), 2)
        sure.append((k, pixels[by_two], depths[by_two]))
    for k, pixels, depths in sure:
        surfaces.add(k, pixels, depths)
    smooth = None
    if len(views) <= SMOOTH_PHOTOS:
        small = [SmallPhoto.of(view, SMOOTH_LONGEST) for view in views]
        asked = [agreement.asked(k) for k in range(len(views))]
        bounds = [surfaces.bounds(k) for k in range(len(views))]
        smooth = DenseDepths(small, asked, bounds, on_stage)
    found = list[Found]()
    for k, share in enumerate(each):
        on_stage(Stage(STAGE, len(views) + k + 1, looks))
        if not share or not surfaces.known(k):
            continue
        pixels = drawn(agreement.looks[k], share, np.random.default_rng([seed, k, 1]))
        depths, kept = _borne_out(agreement, surfaces, k, pixels)
        if smooth is not None:
            between, stands = smooth.at(k, pixels)
            depths, kept = np.where(kept, depths, between), kept | stands
        found.append((k, pixels[kept], depths[kept]))
    return *gathered(views, found), agreeing / max(count, 1)


def _borne_out(
    agreement: Agreement, surfaces: Surfaces, number: int, pixels: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Depths [M] of a view's pixels [M, 2], and which of them others bear out."""
    others = agreement.asked(number, ASKED_AGAIN)
    depths, kept = agreement.depths(number, pixels, surfaces.ranges(number, pixels, AROUND_KNOWN), others)
    kept[kept] = _found_back(agreement, surfaces, number, pixels[kept], depths[kept], others, 1)
    best, ranges = np.full(len(pixels), ALONE), surfaces.ranges(number, pixels)
    for other in others:
        rows = np.flatnonzero(~kept)
        there, scores = agreement.depths_by(number, pixels[rows], ranges[rows], other)
        better = scores > best[rows]
        rows, there, scores = rows[better], there[better], scores[better]
        back = _seen_alike(agreement, number, other, pixels[rows], there)
        rows = rows[back]
        depths[rows], best[rows] = there[back], scores[back]
    return depths, kept | (best > ALONE)


def _found_back(
    agreement: Agreement,
    surfaces: Surfaces,
    number: int,
    pixels: Floats,
    depths: Floats,
    others: Sequence[int],
    wanted: int,
) -> NDArray[np.bool_]:
    """Whether at least `wanted` of the others find pixels [M, 2] of a view back from `depths`."""
    counts = np.zeros(len(pixels), np.intp)
    for other in others:
        rows = np.flatnonzero(counts < wanted)
        if not surfaces.known(other) or not len(rows):
            continue
        at, far, inside = _shown(agreement, number, other, pixels[rows], depths[rows])
        rows, at, far = rows[inside], at[inside], far[inside]
        ranges = surfaces.ranges(other, at)
        ranges = np.stack(
            [np.minimum(ranges[:, 0], far / WIDENED), np.maximum(ranges[:, 1], far * WIDENED)], 1
        )
        there, agreed = agreement.depths(other, at, ranges)
        counts[rows] += agreed & _back(agreement, number, other, pixels[rows], at, there)
    return counts >= wanted


def _seen_alike(
    agreement: Agreement, number: int, other: int, pixels: Floats, depths: Floats
) -> NDArray[np.bool_]:
    """Whether the other photo, by the view alone, finds its pixels [M, 2] at `depths` back."""
    at, far, inside = _shown(agreement, number, other, pixels, depths)
    rows = np.flatnonzero(inside)
    ranges = np.stack([far[rows] / WIDENED, far[rows] * WIDENED], 1)
    there, scores = agreement.depths_by(other, at[rows], ranges, number)
    inside[rows] = (scores > ALONE) & _back(agreement, number, other, pixels[rows], at[rows], there)
    return inside


def _shown(
    agreement: Agreement, number: int, other: int, pixels: Floats, depths: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Where the other photo shows pixels [M, 2] of a view at `depths`, how far away, and whether."""
    look, camera = agreement.looks[number], agreement.looks[other].camera
    points = unproject(look.camera, pixels * look.scale, depths)
    at, far = project(camera, points)
    return at / agreement.looks[other].scale, far, in_frame(camera, points)


def _back(
    agreement: Agreement, number: int, other: int, pixels: Floats, at: Floats, depths: Floats
) -> NDArray[np.bool_]:
    """Whether pixels `at` [M, 2] of the other photo, at `depths`, lie where the view has its `pixels`."""
    look, there = agreement.looks[number], agreement.looks[other]
    again, _ = project(look.camera, unproject(there.camera, at * there.scale, depths))
    return np.linalg.norm(again - pixels * look.scale, axis=1) < FOUND_BACK
