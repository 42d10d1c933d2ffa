"""What a pass of COLMAP came to, in counts.

It imports nothing of hqgs: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pycolmap


def counts(database: Path, placed: set[str]) -> dict[str, Any]:
    """Features of each photo, matches and those that a geometry bears out of each pair, both sorted.

    Of each photo also its best pair's, and how many one with a photo that has a place bears out.
    """
    with pycolmap.Database.open(database) as db:
        images = {image.image_id: image.name for image in db.read_all_images()}
        features = {name: int(db.num_keypoints_for_image(k)) for k, name in images.items()}
        matches = _by_pair(images, *db.read_num_matches())
        inliers = _by_pair(images, *db.read_two_view_geometry_num_inliers())
    best = {name: [0, 0, 0] for name in features}
    for column, found in enumerate((matches, inliers)):
        for pair, count in found.items():
            for name in pair:
                best[name][column] = max(best[name][column], count)
    for (a, b), count in inliers.items():
        for one, other in ((a, b), (b, a)):
            if other in placed:
                best[one][2] = max(best[one][2], count)
    return {
        "features": features,
        "matches": sorted(matches.values(), reverse=True),
        "inliers": sorted(inliers.values(), reverse=True),
        "best": best,
    }


def placed_names(model: pycolmap.Reconstruction) -> set[str]:
    """The photos that have a place in a model."""
    return {model.images[k].name for k in model.reg_image_ids()}


def apart(models: list[set[str]], least: int) -> list[list[str]]:
    """Photos of each model but the first that no model before it has, sorted; of `least` and more."""
    found, known = list[list[str]](), set[str]()
    for names in models:
        if known and len(names - known) >= least:
            found.append(sorted(names - known))
        known |= names
    return found


def _by_pair(images: dict[int, str], pairs: Any, counts: Any) -> dict[tuple[str, str], int]:
    """Counts by the names of two photos."""
    ids = (pycolmap.pair_id_to_image_pair(pair) for pair in pairs)
    return {(images[a], images[b]): int(count) for (a, b), count in zip(ids, counts, strict=True)}
