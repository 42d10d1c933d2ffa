"""What a pass of COLMAP came to, in counts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hqgs.scene.sfm.database import INLIERS, MATCHES, table

EPIPOLAR = pycolmap.TwoViewGeometryOptions().ransac.max_error  # px from its epipolar line that a match may be


def counts(database: Path, names: list[str], placed: set[str]) -> dict[str, Any]:
    """Features of each photo, and the matches of each pair that a geometry bears out, sorted.

    Of each photo also its best pair's, and how many one with a photo that has a place bears out.
    """
    with pycolmap.Database.open(database) as db:
        features = {name: int(db.num_keypoints_for_image(k)) for k, name in enumerate(names, 1)}
    matches, inliers = (table(database, len(names), read) for read in (MATCHES, INLIERS))
    has = np.array([name in placed for name in names])
    best = np.stack([matches.max(1), inliers.max(1), (inliers * has).max(1)], 1)
    pairs = inliers[np.triu(inliers) > 0]
    return {
        "features": features,
        "inliers": sorted(pairs.tolist(), reverse=True),
        "best": dict(zip(names, best.tolist(), strict=True)),
    }


def borne_out(database: Path, model: pycolmap.Reconstruction) -> float:
    """The share of the matches between photos with a place, of those that a geometry of their pair bears out,
    that the places bear out as well: within EPIPOLAR of their epipolar lines (Sampson's distance)."""
    images = {k: model.images[k] for k in model.reg_image_ids()}
    cameras = {k: model.cameras[image.camera_id] for k, image in images.items()}
    rays, agree, total = dict[int, Any](), 0, 0
    with pycolmap.Database.open(database) as db:
        for k in images:
            at = np.asarray(db.read_keypoints(k), np.float64).reshape(-1, 6)[:, :2]
            rays[k] = np.column_stack([np.asarray(cameras[k].cam_from_img(at)), np.ones(len(at))])
        pairs, geometries = db.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches = np.asarray(geometry.inlier_matches)
        if a not in images or b not in images or len(matches) == 0:
            continue
        moved = images[b].cam_from_world() * images[a].cam_from_world().inverse()
        E = np.cross(moved.translation, moved.rotation.matrix(), axisb=0, axisc=0)
        x, y = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
        slopes = np.column_stack([(x @ E.T)[:, :2], (y @ E)[:, :2]])
        focal = min(cameras[k].mean_focal_length() for k in (a, b))
        off = np.abs((y @ E * x).sum(1)) * focal
        agree += int((off <= EPIPOLAR * np.linalg.norm(slopes, axis=1)).sum())
        total += len(matches)
    return agree / max(total, 1)


def apart(models: list[set[str]], least: int) -> list[list[str]]:
    """Photos of each model but the first that no model before it has, sorted; of `least` and more."""
    found, known = list[list[str]](), set[str]()
    for names in models:
        if known and len(names - known) >= least:
            found.append(sorted(names - known))
        known |= names
    return found
