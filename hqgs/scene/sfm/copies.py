"""Which files of a folder are copies of one photo: the same bytes, or a version of it by name and look."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import numpy as np

from hqgs.photos.exif import Exif
from hqgs.photos.files import Glance
from hqgs.photos.suffixes import PHOTO_SUFFIXES

ALIKE = 0.98  # correlation of the small pictures of two versions, at least
PLAIN = 4  # of 255, that a small picture must span to be like another
VERSION = re.compile(
    r"(?<=IMG_)E(?=\d{4})|[ _-]*(copy|kopie|small|resized|thumb|edited|edit|bearbeitet|\d+x\d+)$"
    rf"|({'|'.join(map(re.escape, PHOTO_SUFFIXES))})$",  # IMG_1.heic.jpg
    re.IGNORECASE,
)


def copies(folder: Path, looked: dict[str, Glance], exif: dict[str, Exif]) -> dict[str, str]:
    """Photos that are copies of another, and which other one is used in their place.

    That is the largest, with EXIF data, highest up, with the shortest name: IMG_1.jpg, not "IMG_1 (1).jpg".
    """
    versions, same = dict[str, list[str]](), dict[bytes, list[str]]()
    by_size = dict[int, list[str]]()
    for name in looked:
        place, slash, file = name.rpartition(".")[0].rpartition("/")
        versions.setdefault(f"{place}{slash}{VERSION.sub('', file)}", []).append(name)
        by_size.setdefault((folder / name).stat().st_size, []).append(name)
    for name in (name for names in by_size.values() if len(names) > 1 for name in names):
        same.setdefault(sha256((folder / name).read_bytes()).digest(), []).append(name)
    found: dict[str, str] = {}
    alike = (names for names in versions.values() if _look_alike([looked[name] for name in names]))
    for names in (*alike, *same.values()):
        largest = {n: -looked[n].size[0] * looked[n].size[1] for n in names}
        best = min(names, key=lambda n: (largest[n], not exif[n].camera, n.count("/"), len(n), n))
        found |= {name: best for name in names if name != best}
    return dict(sorted(found.items()))


def _look_alike(looked: list[Glance]) -> bool:
    """Whether pictures are one but for size, format and brightness."""
    small = [one.small.astype(np.float64).ravel() for one in looked]
    shapes = [one.size[0] / one.size[1] for one in looked]
    if len(looked) < 2 or min(map(np.ptp, small)) < PLAIN or max(shapes) > 1.02 * min(shapes):
        return False
    return float(np.corrcoef(small).min()) > ALIKE
