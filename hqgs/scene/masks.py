"""The masks of photos, by every name and in every place that tools give them.

X.png has its mask in X.png, X.png.png, X.jpg, X_mask.png, X-mask.png, X.mask.png, X.png.mask.png, mask_X.png
or mask.X.png of a folder `masks` or `mask`, or beside the photo under a name that says that it is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.base.text import some
from hqgs.photos.exif import read_exif
from hqgs.photos.files import decode, decode_mask, is_shown, stored_size
from hqgs.photos.pixels import luma
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.scene.capture import Capture, Photo
from hqgs.scene.photo_files import Key, below, is_mask_folder, mask_keys, photo_keys

_ASKED, _SIDE = 8, 256  # photos whose edges tell how their masks lie, and about their size
_CLEARER = 1.15  # times as much of the photos' edges along the masks'


def masks_of(root: Path, folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The mask of each photo that has one; `names` are relative to `folder`, of the scene in `root`.

    A mask for photos of several folders that are called alike is nobody's.
    """
    listed = {path: path.relative_to(folder) for path in below(folder, PHOTO_SUFFIXES)}
    for place in (p for p in root.iterdir() if p.is_dir() and is_mask_folder(p.name)):
        listed |= {path: path.relative_to(root) for path in below(place, PHOTO_SUFFIXES)}
    masks: dict[str, list[tuple[Key, Path]]] = {}
    for path, name in listed.items():
        for *folders, last in mask_keys(name.as_posix()):
            masks.setdefault(last, []).append((tuple(folders), path))
    alike: dict[str, set[Key]] = {}
    for name in names if masks else ():
        for *folders, last in photo_keys(name):
            alike.setdefault(last, set()).add(tuple(folders))
    found: dict[str, Path] = {}
    for name in names if masks else ():
        for *folders, last in photo_keys(name):  # with its suffix first: X.jpg beside X.png
            fitting = [
                (min(len(own), len(folders)), path)
                for own, path in masks.get(last, [])
                if _ends(own, folders)
                or (_ends(folders, own) and sum(_ends(k, own) for k in alike[last]) == 1)
            ]
            if fitting:
                found[name] = max(fitting, key=lambda one: one[0])[1]
                break
    return found


def _ends(folders: Sequence[str], last: Sequence[str]) -> bool:
    return [*folders[len(folders) - len(last) :]] == [*last] if len(last) <= len(folders) else False


def told(root: Path, capture: Capture) -> list[str]:
    """Which photos have a mask, in a sentence; nothing where there is none, nor a folder for them."""
    bare = [photo.name for photo in capture.photos if photo.mask_path is None]
    masks = [photo.mask_path.name for photo in capture.photos if photo.mask_path is not None]
    if masks:
        which = f"{len(masks)} of {len(capture.photos)} photos have a mask, such as {masks[0]}"
        return [which + (f"; these have none, so all their pixels count: {some(bare)}" if bare else "")]
    for place in (root, capture.folder or root):
        if found := [p.name for p in place.iterdir() if p.is_dir() and is_mask_folder(p.name)]:
            return [f"masks are in {found[0]}, but are not used, as none has the name of a photo"]
    return []


def with_turns(photos: list[Photo], notes: list[str]) -> list[Photo]:
    """The photos, each with whether its mask shows it upright, as EXIF says, or as it is stored.

    Where shapes do not tell (photos upside down, or square), the photos' edges along those of the masks do,
    or that is how it was with the others; `notes` says so.
    """
    turned = [
        (photo, exif.orientation)
        for photo in photos
        if photo.mask_path is not None and (exif := read_exif(photo.path)).orientation > 1
    ]
    shapes = {photo.name: _shape(photo, orientation) for photo, orientation in turned}
    known = [shown for shown in shapes.values() if shown is not None]
    if not turned or len(known) == len(turned):
        return photos
    if known:
        shown, why = 2 * sum(known) >= len(known), "as masks of other photos are"
    else:
        asked = [turned[k] for k in evenly(len(turned), _ASKED)]
        ratios = [
            ratio for photo, orientation in asked if (ratio := _clearer(photo, orientation)) is not None
        ]
        ratio = float(np.exp(np.mean(np.log(ratios)))) if ratios else 1.0
        shown = ratio > _CLEARER
        sure = max(ratio, 1 / ratio) > _CLEARER
        why = "as edges in the photos show" if sure else "though that is not certain: check them"
    notes.append(
        f"{len(turned)} photos are rotated by EXIF: their masks are used as masks of photos "
        f"{'shown upright' if shown else 'as they are stored'}, {why}"
    )
    return [replace(photo, mask_shown=shown) if photo.name in shapes else photo for photo in photos]


def _shape(photo: Photo, orientation: int) -> bool | None:
    assert photo.mask_path is not None
    try:
        return is_shown(photo.mask_path, *stored_size(photo.path), orientation)
    except ValueError:  # decoding it names the same mistake
        return False


def _clearer(photo: Photo, orientation: int) -> float | None:
    """How much more of a photo's edges lies along its mask's if that shows it upright; None: nothing."""
    assert photo.mask_path is not None
    try:
        grey = luma(decode(photo.path, (_SIDE, _SIDE))[0].astype(np.float64))
        height, width = grey.shape
        masks = [decode_mask(photo.mask_path, width, height, orientation, shown) for shown in (True, False)]
    except ValueError:
        return None
    steps = _slope(grey)
    shown, stored = (float(steps[_slope(mask.astype(np.float64)) > 0].sum()) for mask in masks)
    return (shown + 1) / (stored + 1)  # as long an edge either way


def _slope(grey: NDArray[np.floating]) -> NDArray[np.floating]:
    down, right = np.gradient(grey)
    return np.hypot(down, right)
