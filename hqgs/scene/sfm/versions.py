"""Several versions of each photo side by side: noise and blocks hide features that a smoothed copy shows.

No single strength is best for all photos; the features of all versions can lie in one database. Each
version is matched by itself: a feature that two versions show would pass for ambiguous. It imports of
hqgs what needs nothing else: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.ndimage import gaussian_filter

from hqgs.photos.pixels import grey
from hqgs.scene.constants import JPEG_QUALITY


def smoothed_copies(photos: Path, out: Path, names: Sequence[str], sigma: float, largest: int) -> None:
    """Gray copies of the photos in the new folder `out`, smoothed by `sigma` px of what SIFT sees.

    It sees photos whose longest side has more than `largest` px at that size.
    """
    new = out.with_name(f"{out.name}.new")
    for name in names:
        target = new / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(photos / name) as image:
            gray = np.asarray(grey(image), np.float32)
        smooth = gaussian_filter(gray, sigma * max(1, max(gray.shape) / largest), mode="nearest")
        Image.fromarray(np.rint(smooth).astype(np.uint8)).save(target, quality=JPEG_QUALITY, compress_level=1)
    new.rename(out)


def join(versions: Sequence[Path], into: Path, photos: int) -> None:
    """Write the features and matches of databases, one for each version, into one that has the photos.

    Features of the first version come first. Their geometry is not checked yet.
    """
    keypoints = [[np.zeros((0, 6), np.float32)] * photos for _ in versions]
    matches: dict[tuple[int, int], list[np.ndarray]] = {}
    before = np.zeros(photos, np.int64)  # features of earlier versions
    for found, version in zip(keypoints, versions, strict=True):
        with pycolmap.Database.open(version) as db:
            for k in range(photos):
                if db.exists_keypoints(k + 1):
                    found[k] = np.asarray(db.read_keypoints(k + 1), np.float32)
            for pair, rows in zip(*db.read_all_matches(), strict=True):
                first, second = pycolmap.pair_id_to_image_pair(pair)
                moved = np.asarray(rows, np.int64) + before[[first - 1, second - 1]]
                matches.setdefault((first, second), []).append(moved)
        before = before + [len(one) for one in found]
    with pycolmap.Database.open(into) as db:
        for k in range(photos):
            db.write_keypoints(k + 1, np.concatenate([found[k] for found in keypoints]))
        for (first, second), rows in sorted(matches.items()):
            db.write_matches(first, second, np.concatenate(rows).astype(np.uint32))
