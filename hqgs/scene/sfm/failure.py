"""Why COLMAP found no scene in photos, told from what it saw in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FEW_FEATURES = 150  # a photo with fewer is blurred, or shows nothing that can be found again
ENOUGH_INLIERS = 30  # a pair with so many matches that one geometry bears out shows the same thing


@dataclass(frozen=True)
class Pass:
    """What one pass of COLMAP came to."""

    tolerant: bool
    registered: int  # photos
    features: dict[str, int]  # of each photo
    matches: list[int]  # of each pair that has any, sorted
    inliers: list[int]  # of them, those that one geometry bears out, sorted


def why_no_model(photos: int, passes: Sequence[Pass]) -> str:
    """Why no model could be started, with counts, and what to do; a sentence or two for the user."""
    counts = _counts(photos, passes)
    last = passes[-1]
    told = f"COLMAP could start from no two of the {photos} photos. {counts}. "
    if _is_poor(passes[0]):
        return told + (
            "So few features mean blurred or dark photos, or bare surfaces: take sharp photos of things with "
            "texture"
        )
    if _pairs(last) == 0:
        return told + (
            "The photos are rich in detail but show different things: no overlap. Take each photo so that it "
            "shares two thirds of its picture with the next one"
        )
    if photos < 10:
        return told + "That is too few photos: take 20 to 100, a step apart, each overlapping the next"
    return told + (
        "Photos overlap, but were taken from one place, or lie too far apart: walk around the scene, a step "
        "between photos"
    )


def why_few(photos: int, passes: Sequence[Pass]) -> str:
    """What to do where some photos have no place; one sentence with counts."""
    first = passes[0]
    poor = sorted(name for name, count in first.features.items() if count < FEW_FEATURES)
    if _is_poor(first):
        advice = "the photos are blurred, dark or without texture: take sharper ones"
    elif poor and 2 * len(poor) >= photos - max(one.registered for one in passes):
        advice = f"{len(poor)} photos show few features (blurred, dark or bare surfaces)"
    else:
        advice = "the others overlap too little with these: take more photos in between"
    return f"{_counts(photos, passes)}; {advice}"


def _counts(photos: int, passes: Sequence[Pass]) -> str:
    first, pairs = passes[0], photos * (photos - 1) // 2
    features = list(first.features.values()) or [0]
    found = (
        f"It found {int(np.median(features)):,} features in a photo (median; fewest {min(features):,}), and "
        f"{_pairs(first):,} of {pairs:,} pairs of photos match (most matches: {max([0, *first.inliers]):,})"
    )
    if len(passes) > 1:
        found += f"; in a second, more tolerant pass {_pairs(passes[1]):,} pairs"
    return found


def _is_poor(one: Pass) -> bool:
    return float(np.median(list(one.features.values()) or [0])) < FEW_FEATURES


def _pairs(one: Pass) -> int:
    return sum(count >= ENOUGH_INLIERS for count in one.inliers)
