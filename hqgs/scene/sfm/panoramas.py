"""Photos of 360 x 180 degrees: how they are told from others, and the faces of them that COLMAP sees."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from hqgs.base.evenly import evenly
from hqgs.base.text import some
from hqgs.photos.exif import Exif
from hqgs.photos.files import Glance, UnreadableError, decode
from hqgs.scene.faces import Face, around, faces_of
from hqgs.scene.sfm.database import LEAST_PHOTOS, PROBED, seen_size
from hqgs.scene.views import to_pinhole

POLE = 0.35  # of the picture's contrast: its first and last rows show a point each
PLAIN = 0.25  # the same: a border with less shows nothing
FINER = 4 / math.pi  # times a face's pixels: in its middle as fine as the photo, so that SIFT sees all of it


def all_around(folder: Path, looked: dict[str, Glance], exif: dict[str, Exif]) -> tuple[bool, list[str]]:
    """Whether the photos are panoramas of the whole sphere (equirectangular), and those of the other kind.

    Panoramas say so in their files (GPano), or they are twice as wide as high, end on the right where they
    begin on the left, and show one point along their upper and lower borders: some, spread over those of that
    shape, stand for the others. COLMAP matches no face with a flat photo: a run takes the kind that has more.

    ValueError where panoramas are parts of a sphere, or too few.
    """
    tagged = [name for name, tags in exif.items() if tags.panorama is not None]
    whole = [name for name, seen in looked.items() if seen.size[0] == 2 * seen.size[1]]
    found = [name for name in whole if exif[name].panorama]
    untold = [name for name in whole if exif[name].panorama is None]
    picks = [untold[k] for k in evenly(len(untold), PROBED)]
    if 2 * sum(_closes(folder / name) for name in picks) > len(picks):
        found += untold
    if not found and 2 * len(tagged) > len(looked):
        name = tagged[0]
        width, height = looked[name].size
        raise ValueError(
            f"{folder}: {len(tagged)} of {len(looked)} photos are tagged as panoramas, but do not show the "
            f"whole sphere, twice as wide as high ({name}: {width} x {height} px): export the whole sphere, "
            "360 x 180 degrees, equirectangular"
        )
    flat = [name for name in looked if name not in {*found, *tagged}]
    if len(flat) >= max(len(found), LEAST_PHOTOS):
        return False, [name for name in looked if name not in set(flat)]
    if found and len(found) < LEAST_PHOTOS:
        raise ValueError(
            f"{folder}: {len(found)} panorama{'s' * (len(found) > 1)} of 360 x 180 degrees ({some(found)}) "
            f"show no depth, wanted at least {LEAST_PHOTOS}: take 10 to 50, a step apart"
        )
    return bool(found), [name for name in looked if found and name not in set(found)]


def _closes(path: Path) -> bool:
    """Whether a picture looks like a panorama of the whole sphere."""
    try:
        pixels = decode(path)[0].astype(np.float32)
    except UnreadableError:
        return False
    contrast = pixels.std((0, 1)).mean()
    apart = np.abs(np.diff(pixels, axis=1)).mean((0, 2))
    seam = np.abs(pixels[:, 0] - pixels[:, -1]).mean()
    poles, border = pixels[[0, -1]].std(1).mean(1), pixels[:, 0].std(0).mean()
    # the last column and the first are neighbours; the first row and the last show a point each
    joined, poles_plain = seam <= 2 * np.median(apart), (poles <= POLE * contrast).all()
    return bool(joined and poles_plain and border > PLAIN * contrast)


def colmap_faces(width: int, height: int) -> tuple[Face, ...]:
    """The faces of a panorama that COLMAP sees."""
    return faces_of(around(width, height), FINER)


def faces_seen(path: Path, largest: int) -> Iterator[Image.Image]:
    """The faces of a panorama, in the order of `colmap_faces`, no side longer than about `largest` px."""
    pixels, _ = decode(path)
    height, width = pixels.shape[:2]
    camera = around(width, height)
    for face in colmap_faces(width, height):
        picture = Image.fromarray(to_pinhole(camera, width, height, face=face).picture(pixels))
        size = seen_size(picture.size, largest)
        yield picture if size == picture.size else picture.resize(size, Image.Resampling.BOX)
