"""Why COLMAP found no scene in photos, or no place for some, told from what it saw in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pycolmap

from hqgs.base.text import some
from hqgs.scene.sfm.refine.agree import JOINT, confirmed

MATCHES = pycolmap.TwoViewGeometryOptions().min_num_inliers  # that agree, of a pair; COLMAP's own
FEW_FEATURES = 150  # a photo with fewer is blurred, or shows nothing that can be found again
BORNE_OUT = 0.85  # of matches between panoramas: 0.91 and 0.93 at right places, 0.68 and 0.79 at wrong ones


@dataclass(frozen=True)
class Outcome:
    """What COLMAP's best pass came to."""

    registered: int  # photos
    features: dict[str, int]  # of each photo
    inliers: list[int]  # of each pair, the matches that one geometry bears out, sorted
    best: dict[str, list[int]] = field(default_factory=dict)  # of each photo's best pairs: matches, of them
    # those that a geometry bears out, and the same with a photo that has a place
    apart: list[list[str]] = field(default_factory=list)  # photos that fit each other, and no others
    agree: dict[str, list[int]] = field(default_factory=dict)  # of photos with a place, where that was looked
    # at: points that they should show, those that show, and those that show where only chance puts them
    loose: list[tuple[list[str], int]] = field(default_factory=list)  # photos that share few points with the
    # rest, and how many
    borne_out: float | None = None  # share of the inliers that the places of panoramas bear out


def why_few(one: Outcome) -> str:
    """Why few of the photos have a place, or none, with counts, and what to do; a sentence or two."""
    if _usual(one.features) < FEW_FEATURES:
        advice = (
            "So few features mean that photos are blurred or dark, or surfaces have no texture: take sharp "
            "photos of things with texture"
        )
    elif _pairs(one) == 0:
        advice = (
            "The photos have enough detail, but do not overlap. Take each photo so that two thirds of it "
            "show what the next photo shows"
        )
    elif one.registered:
        advice = "The other photos overlap too little with these: take more photos in between"
    else:
        advice = (
            "The photos overlap, but are too few (take 20 to 100), were taken from one place, or from places "
            "too far apart: walk around the scene and take a photo at each step"
        )
    return f"{counts(one)}. {advice}"


def why_lost(name: str, one: Outcome) -> str:
    """Why a pass found no place for a photo, in words with numbers."""
    features, usual = one.features[name], _usual(one.features)
    matches, inliers, with_placed = one.best[name]
    if features < max(FEW_FEATURES, usual / 4):
        return f"blurred, dark or without texture: {features:,} features (median of all photos: {usual:,.0f})"
    if matches < MATCHES:
        return "it matches no other photo"
    if inliers < MATCHES:
        return f"{matches} matches with its best partner, of which only {inliers} fit one camera geometry"
    if with_placed < MATCHES:
        return "it only matches photos that have no pose either"
    return f"too few matches ({with_placed}) with photos that have a pose"


def what_to_take(lost: Mapping[str, str], apart: Sequence[Sequence[str]]) -> str:
    """What to photograph so that the lost photos, by `why_lost`, find a place."""
    captures = [[name for name in group if name in lost] for group in apart]
    said = [
        f"{len(group)} photos match each other but no others ({some(group)}): put another scene into its own "
        "folder; for the same scene, take photos in between"
        for group in captures
        if group
    ]
    others = [name for name in lost if not any(name in group for group in captures)]
    if blurred := [name for name in others if lost[name].startswith("blurred")]:
        said.append(f"take these photos again, sharp and bright: {some(blurred)}")
    if loose := [name for name in others if name not in blurred]:
        said.append(f"take photos between the others and {some(loose)}")
    return "; ".join(said)


def doubtful(one: Outcome) -> list[str]:
    """Photos whose places are no better than chance: they do not show what they should."""
    return sorted(
        name
        for name, (looked, *found) in one.agree.items()
        if looked >= JOINT and not confirmed(looked, *found)
    )


def why_doubtful(one: Outcome, called: Callable[[str], str] = str) -> str:
    """That places may be wrong, and what to do; empty where nothing says so."""
    if one.loose and not doubtful(one):
        parts = [f"{some([called(name) for name in part])} by {points} points" for part, points in one.loose]
        return (
            "Poses may be wrong where photos share only few points with the others: "
            f"{'; '.join(parts)}. Take photos between these and the others"
        )
    if wrong := doubtful(one):
        looked, agreed, beside = np.median([one.agree[name] for name in wrong], axis=0)
        return (
            f"The poses of {len(wrong)} photos may be wrong ({some([called(name) for name in wrong])}): of "
            f"{looked:.0f} points that should be visible, {agreed:.0f} are found, at random places "
            f"{beside:.0f} (medians). Take sharper, larger photos between these and the others"
        )
    if one.borne_out is None or one.borne_out >= BORNE_OUT:
        return ""
    return (
        f"Poses may be wrong: only {one.borne_out:.0%} of the matches between panoramas fit them (usually "
        f"{BORNE_OUT:.0%} and more). Use the panoramas at full size, or take more of them, closer together, "
        "where floors and walls look less alike"
    )


def counts(one: Outcome) -> str:
    """What was found, in numbers."""
    photos, fewest = len(one.features), min(one.features.values(), default=0)
    return (
        f"It found {int(_usual(one.features)):,} features per photo (median; fewest {fewest:,}), and "
        f"{_pairs(one):,} of {photos * (photos - 1) // 2:,} pairs of photos match (most matches: "
        f"{max([0, *one.inliers]):,})"
    )


def _usual(features: Mapping[str, int]) -> float:
    return float(np.median([*features.values()] or [0]))


def _pairs(one: Outcome) -> int:
    return sum(count >= 30 for count in one.inliers)  # of so many matches: they show the same thing
