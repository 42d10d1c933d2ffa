"""Where another photo would help most, by trust: places beside the photos from where little is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hqgs.base.evenly import evenly
from hqgs.scene.camera_files import KnownCamera
from hqgs.scene.constants import NEXT_MOST
from hqgs.scene.geometry import shrunk_camera
from hqgs.scene.next_photos import Spot
from hqgs.scene.paths import view_matrix
from hqgs.scene.scene import Camera
from hqgs.show.constants import SPOT_PHOTOS, SPOT_SIDE, SPOT_STEP, SPOT_WORSE
from hqgs.show.trust import Trust
from hqgs.show.trust_measured import said_of

Array = np.ndarray
SIDES = {
    "above": (1, -1),
    "right of": (0, 1),
    "below": (1, 1),
    "left of": (0, -1),
}  # axis of the camera, sign


def doubtful_spots(trust: Trust, photos: Sequence[KnownCamera]) -> list[Spot]:
    """Places a step to the left, right, above or below a photo, and looking as it does, from where the
    pixels' trust is least; none where it is about that of the photos' own places.
    """
    if len(photos) < 2:
        return []
    centers = np.stack([photo.camera.center for photo in photos])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    usual = float(np.median(np.sort(apart, axis=1)[:, 1]))
    if not usual > 0:
        return []
    chosen = [photos[k] for k in evenly(len(photos), SPOT_PHOTOS)]
    own = float(np.median([_said(trust, photo.camera) for photo in chosen]))
    found = list[tuple[float, Spot]]()
    for photo in chosen:
        R, center = photo.camera.viewmat[:3, :3], photo.camera.center
        for where, (axis, sign) in SIDES.items():
            at = center + sign * SPOT_STEP * usual * R[axis]
            if np.linalg.norm(centers - at, axis=1).min() < SPOT_STEP / 2 * usual:
                continue  # another photo is there
            said = _said(trust, replace(photo.camera, viewmat=view_matrix(R, at)))
            if said < own - SPOT_WORSE:
                words = f"{where} {photo.name}: what is seen from there is {own - said:.0f} dB less sure"
                found.append((said, Spot(at, words, (photo.name,))))
    spots = list[Spot]()
    for _, spot in sorted(found, key=lambda one: one[0]):
        if all(np.linalg.norm(spot.at - other.at) > SPOT_STEP * usual for other in spots):
            spots.append(spot)
    return spots[:NEXT_MOST]


def _said(trust: Trust, camera: Camera) -> float:
    return said_of(*trust.shown(shrunk_camera(camera, SPOT_SIDE), trust.errors))
