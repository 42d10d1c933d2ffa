"""Whether photos differ from one another: in sharpness, each in a direction of its own, or in their gains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.constants import LARGEST, SECTORS, UNLIKE_COARSE, UNLIKE_FINE
from hqgs.diagnosis.sharpness import Sharpness, summarised
from hqgs.photos.pixels import as_floats, luma
from hqgs.scene.constants import FEWEST_PHOTOS
from hqgs.scene.scene import Scene


@dataclass(frozen=True)
class Unlike:
    """How photos differ from one another in the logarithms of their power spectra."""

    sharpness: float  # by how much more in fine details than in coarse ones, standard deviations over photos
    direction: float  # standard deviation over photos and directions of the finer details, less each mean


def unlike_sharpness(scene: Scene) -> Unlike | None:
    """Of the training photos; None where they are too few or too small to tell.

    What happens to all photos alike (blur, noise, JPEG, shrinking) moves them together: sharpness differs by
    less than 0.15 then, and by 0.25 to 1.3 where each photo was shaken in its own way. Shake takes the fine
    details of one direction, so that the direction differs by 0.5 and more; where photos are out of focus by
    different amounts it does not. Faces of panoramas are compared with those of their direction: each was
    resampled in its own way.
    """
    if len(scene.train) < FEWEST_PHOTOS:
        return None
    looks = [look.rings for look in summarised(scene.train)]
    rings = [found for found in looks if found is not None]
    if len(rings) < len(looks):
        return None
    quarters = Sharpness(rings).quarters()
    directions = np.stack([_directions(view.image) for view in scene.train])
    faces = np.array([view.face for view in scene.train])
    for face in np.unique(faces):
        alike = faces == face
        if not alike.all():
            quarters[:, alike] -= np.median(quarters[:, alike], axis=1, keepdims=True)
        directions[alike] -= np.median(directions[alike], axis=0)
    coarse, *finer = quarters.std(axis=1)
    directions -= directions.mean(1, keepdims=True)
    return Unlike(float(max(finer) - coarse), float(directions.std()))


def _directions(photo: NDArray[Any]) -> NDArray[np.float64]:
    """Log ratio of the power of fine to coarse details for each direction, [8]."""
    top, left = (max(side - LARGEST, 0) // 2 for side in photo.shape[:2])
    grey = luma(as_floats(photo[top : top + LARGEST, left : left + LARGEST])).astype(np.float64)
    window = np.hanning(grey.shape[0])[:, None] * np.hanning(grey.shape[1])
    power = np.abs(np.fft.fft2((grey - grey.mean()) * window)) ** 2
    rows, columns = np.fft.fftfreq(grey.shape[0])[:, None], np.fft.fftfreq(grey.shape[1])
    radius = np.hypot(rows, columns)
    sector = (np.arctan2(rows, columns) % np.pi * SECTORS / np.pi).astype(int) % SECTORS

    def logs(band: tuple[float, float]) -> NDArray[np.float64]:
        chosen = (radius > band[0]) & (radius < band[1])
        sums = np.bincount(sector[chosen], power[chosen], SECTORS)
        return np.log(sums / np.bincount(sector[chosen], minlength=SECTORS).clip(1) + 1e-12)

    return logs(UNLIKE_FINE) - logs(UNLIKE_COARSE)
