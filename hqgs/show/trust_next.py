"""Where another photo would help most, by trust: places beside the photos from where little is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hqgs.base.evenly import evenly
from hqgs.scene.camera_files import KnownCamera
from hqgs.scene.next_photos import Spot
from hqgs.scene.paths import resized, view_matrix
from hqgs.scene.scene import Camera
from hqgs.show.trust import Trust
from hqgs.show.trust_measured import said_of

BESIDE = 24  # photos around which places are tried
STEP = 2.0  # of the usual distance to the next photo
SIDE = 120  # px of a picture that tells how much is known
WORSE = 3.0  # dB below what the photos' own places say: no less is told
MOST = 2  # places that are told
Array = np.ndarray


def doubtful_spots(trust: Trust, photos: Sequence[KnownCamera]) -> list[Spot]:
    """Places a step to the left, right, above or below a photo, and looking as it does, from where the
    pixels' trust is least; none where it is about that of the photos' own places."""
    if len(photos) < 2:
        return []
    centers = np.stack([photo.camera.center for photo in photos])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    usual = float(np.median(np.sort(apart, axis=1)[:, 1]))
    if not usual > 0:
        return []
    chosen = [photos[k] for k in evenly(len(photos), BESIDE)]
    own = float(np.median([_said(trust, photo.camera) for photo in chosen]))
    found = list[tuple[float, Spot]]()
    for photo in chosen:
        R, center = photo.camera.viewmat[:3, :3], photo.camera.center
        for axis, sign, where in ((0, -1, "left of"), (0, 1, "right of"), (1, -1, "above"), (1, 1, "below")):
            at = center + sign * STEP * usual * R[axis]
            if np.linalg.norm(centers - at, axis=1).min() < STEP / 2 * usual:
                continue  # another photo is there
            said = _said(trust, replace(photo.camera, viewmat=view_matrix(R, at)))
            if said < own - WORSE:
                words = f"{where} {photo.name}: what is seen from there is {own - said:.0f} dB less sure"
                found.append((said, Spot(at, words, (photo.name,))))
    spots = list[Spot]()
    for _, spot in sorted(found, key=lambda one: one[0]):
        if all(np.linalg.norm(spot.at - other.at) > STEP * usual for other in spots):
            spots.append(spot)
    return spots[:MOST]


def _said(trust: Trust, camera: Camera) -> float:
    share = SIDE / max(camera.width, camera.height)
    small = resized(camera, max(1, round(share * camera.width)), max(1, round(share * camera.height)))
    return said_of(*trust.shown(small, trust.errors))
