"""Whether photos differ from one another: in sharpness, as shaken ones do, or in their gains."""

from __future__ import annotations

import numpy as np

from hqgs.diagnosis.gains import log_gains
from hqgs.diagnosis.sharpness import Sharpness, look_at_photos
from hqgs.scene.scene import Scene

UNLIKE = 0.45  # of the log power of the finest details, standard deviation over the photos
UNLIKE_GAINS = 0.05  # of the log gains
FEWEST = 5  # photos


def sharpness_spread(scene: Scene) -> float | None:
    """Standard deviation over the training photos of the log power of their finer details.

    Sharp captures have 0.05 to 0.1, hand-held film 0.26; what happens to all photos alike (blur, noise, JPEG)
    moves them together. Photos that were shaken each in its own way have 0.6 and more. None where the photos
    are too few or too small to tell.
    """
    if len(scene.train) < FEWEST:
        return None
    rings = [look.rings for look in look_at_photos(scene.train)]
    known = [of_photo for of_photo in rings if of_photo is not None]
    return float(Sharpness(known).fine().std()) if len(known) == len(rings) else None


def gain_spread(scene: Scene) -> float | None:
    """Standard deviation of the photos' own log gains, the largest of the channels; None: it is not told."""
    gains = log_gains(scene)
    return None if gains is None else float(np.std(gains, axis=0).max())
