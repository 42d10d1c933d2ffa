"""What of a capture is used, and in which frame: cameras without a photo or far off, units, the origin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.base.text import some
from hqgs.photos.exif import read_exif
from hqgs.photos.files import is_cut_out
from hqgs.scene.capture import Capture, Photo
from hqgs.scene.constants import GPS_LEAST, ONE_PLACE, SHOWN
from hqgs.scene.geometry import project, within
from hqgs.scene.georeference import Georeference, georeference
from hqgs.scene.scene import Camera, strays
from hqgs.scene.world import world_for

LOOKED_AT = 1000  # points of a scene that tell what a camera shows


def without_missing(root: Path, capture: Capture, notes: list[str]) -> Capture:
    """The capture without cameras whose photo is not there; `notes` names them.

    The places of the others in the split stay what they were. FileNotFoundError where more than half miss.
    """
    missing = [photo for photo in capture.photos if not photo.path.exists()]
    if not missing:
        return capture
    names, count = some([photo.name for photo in missing]), len(capture.photos)
    if 2 * len(missing) > count:
        raise FileNotFoundError(
            f"{len(missing)} of {count} cameras have no photo in {capture.folder or root}: {names}"
        )
    notes.append(f"{len(missing)} of {count} cameras have no photo any more and were left out: {names}")
    return _without(capture, {photo.name for photo in missing})


def without_poseless(root: Path, capture: Capture, notes: list[str]) -> Capture:
    """The capture without photos that its files give no place; `notes` names them.

    ValueError where more than half have none, or all have the same.
    """
    lost = {photo.name for photo in capture.photos if not np.isfinite(photo.viewmat).all()}
    names, count = some(sorted(lost)), len(capture.photos)
    if 2 * len(lost) > count:
        raise ValueError(f"{root}: {len(lost)} of {count} photos have no pose: {names}")
    if lost:
        notes.append(
            f"{len(lost)} of {count} photos have no pose (nan, 0 or null) and were left out: {names}"
        )
    found = _without(capture, lost)
    first = found.photos[0].viewmat
    if len(found.photos) > 2 and all(np.array_equal(photo.viewmat, first) for photo in found.photos):
        raise ValueError(
            f"{root}: all {len(found.photos)} photos have the same pose, which cannot be right; `--sfm` "
            "finds poses"
        )
    return found


def without_strays(capture: Capture, notes: list[str]) -> Capture:
    """The capture without cameras that lie far from all others and show nothing; `notes` names them.

    A camera over 20 times as far away as half of them goes if the points are outside of its picture, or
    a dot in it: its pose is a mistake of the reconstruction. Without points nothing tells a mistake from a
    walk that leaves a room in which most photos were taken.
    """
    if len(capture.photos) < 4 or not len(capture.points):
        return capture
    points = capture.points[:: max(1, len(capture.points) // LOOKED_AT)].astype(np.float64)
    far = strays(_centers(capture), 20.0)
    away = [photo for photo, off in zip(capture.photos, far, strict=True) if off]
    sure = {photo.path for photo in away if _shows(photo, points)}  # all faces of a photo stay, or none
    gone = {photo.name for photo in away if photo.path not in sure}
    if gone:
        notes.append(
            f"{len(gone)} of {len(capture.photos)} cameras are far from all others, see none of the points "
            f"and were left out: {some(sorted(gone))}"
        )
    return _without(capture, gone)


def cut_outs(capture: Capture) -> bool:
    """Whether the photos are of cut-out objects, so that what is transparent is empty.

    They are where each of them can be transparent and none has a mask file. In other sets alpha is a mask.
    Photos that cannot be opened have no say.
    """
    photos = [photo for photo in capture.photos if photo.path.is_file()]
    if not photos or any(photo.mask_path is not None for photo in photos):
        return False
    return all(is_cut_out(photo.path) is not False for photo in photos)


def in_one_place(capture: Capture) -> bool:
    """Whether all of more than two cameras stand where the first does, but for rounding."""
    centers = _centers(capture)
    return len(centers) > 2 and bool(np.ptp(centers, axis=0).max() <= ONE_PLACE * np.abs(centers).max())


def placed(capture: Capture, notes: list[str]) -> Capture:
    """The capture near the origin and of an ordinary size; `notes` says in which frame, if in another."""
    if in_one_place(capture):
        notes.append(
            f"all {len(capture.photos)} cameras are at the same place, so distances are unknown: are the "
            "poses inverted (world to camera instead of camera to world)?"
        )
    world = world_for(_centers(capture), capture.points)
    if world.ordinary:
        return capture
    notes.append(f"coordinates are converted to {world}; files are written in the frame of the input")
    photos = [replace(photo, viewmat=world.viewmat_into(photo.viewmat)) for photo in capture.photos]
    bounds = {k: (near / world.unit, far / world.unit) for k, (near, far) in capture.near_far.items()}
    return replace(capture, photos=photos, points=world.into(capture.points), near_far=bounds, world=world)


def located(capture: Capture) -> Georeference | None:
    """Where on Earth the frame of the capture's files is, by the GPS of its photos; None: nothing tells."""
    first = {photo.path: k for k, photo in reversed([*enumerate(capture.photos)])}  # of the faces of a photo
    found = [(k, tags.gps, tags.above) for path, k in sorted(first.items(), key=lambda item: item[1])
             if (tags := read_exif(path)).gps]  # fmt: skip
    if len(found) < GPS_LEAST:
        return None
    rows, gps, above = zip(*found, strict=True)
    centers = capture.world.out(_centers(capture))[[*rows]].astype(np.float64)
    places = np.array(gps)
    high = np.isfinite(places[:, 2])
    if np.isfinite(above).all() and high.any():  # a barometer tells heights better, but for where they begin
        places[:, 2] = np.array(above) + np.median((places[:, 2] - above)[high])
    return georeference(centers, [(north, east, up) for north, east, up in places.tolist()])


def _without(capture: Capture, gone: set[str]) -> Capture:
    kept = [photo for photo in capture.photos if photo.name not in gone]
    return capture if not gone else replace(capture, photos=kept)


def _centers(capture: Capture) -> NDArray[np.float64]:
    return np.stack([-p.viewmat[:3, :3].T @ p.viewmat[:3, 3] for p in capture.photos])


def _shows(photo: Photo, points: NDArray[np.float64]) -> bool:
    """Whether points [P, 3] are in a photo, as more than a dot. What a lens bends does not matter here."""
    part = photo.face or photo.camera
    K = photo.camera.calibration_matrix() if photo.face is None else photo.face.K
    camera = Camera(part.width, part.height, K, photo.viewmat)
    pixels, depths = project(camera, points)
    shares = pixels[within(camera, pixels, depths)] / (part.width, part.height)
    return len(shares) > 0 and float(np.ptp(shares, axis=0).max()) > SHOWN
