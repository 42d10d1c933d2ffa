"""What one photo shows, from the last step of its making back to the first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.blur import Blur, estimate_blur, extra_sigma
from hqgs.diagnosis.coefficients import Hidden, estimate_hidden, quantised
from hqgs.diagnosis.jpeg import Jpeg, find_jpeg
from hqgs.diagnosis.levels import to_levels
from hqgs.diagnosis.noise import estimate_noise
from hqgs.diagnosis.resolution import Enlargement, find_enlargement, undo_enlargement

LEAST_BLUR = 0.7  # px of the small photo, a Gaussian's sigma; photos that count as sharp reach 0.6
HIDING_QUALITY = 92  # from this quality on, JPEG leaves noise and spectrum as they were

Photo = NDArray[np.uint8] | NDArray[np.float32]


@dataclass(frozen=True)
class PhotoDiagnosis:
    """Estimates for one photo; those of JPEG and noise belong to the photo before it was enlarged."""

    name: str
    height: int  # px
    width: int
    enlargement: Enlargement
    jpeg: Jpeg
    noise: float | None  # levels of 1/255 in each channel; None: not told from this photo
    noise_limit: float  # levels: weaker noise is not told from texture, or hidden by the JPEG
    blur: Blur | None  # beyond a sharp photo's own, px of the full-size photo; None: not told from this photo
    blur_limit: float  # px of the full-size photo, a Gaussian's sigma: sharp photos can look as soft

    @property
    def hiding(self) -> bool:
        """Whether its JPEG hides the photo's noise and blur from all but the coefficients."""
        return self.jpeg.quality is not None and self.jpeg.quality < HIDING_QUALITY


@dataclass(frozen=True)
class Inspected:
    """A photo's diagnosis, and the coefficients that a hiding JPEG leaves to judge noise and blur by."""

    diagnosis: PhotoDiagnosis
    steps: NDArray[np.int64] | None  # [blocks, 63]; the diagnosis has no noise and blur yet


def diagnose_photo(image: Photo, low: Photo | None = None, path: Path | None = None) -> PhotoDiagnosis:
    """What degraded a photo [H, W, 3]: enlargement, then of the small photo JPEG, noise and blur.

    `low` is the small photo [h, w, 3] where it is at hand; `path` the photo's file, whose quantisation table
    is taken if it is a JPEG and the pixels bear it out. ValueError for another shape or type, values that are
    not finite, or a `low` larger than the photo; FileNotFoundError for a missing file.
    """
    found = inspect_photo("photo", image, low, path)
    if found.steps is None:
        return found.diagnosis
    table = np.array(found.diagnosis.jpeg.table)
    return with_hidden(found.diagnosis, estimate_hidden(found.steps, table))


def inspect_photo(
    name: str,
    image: Photo,
    low: Photo | None = None,
    path: Path | None = None,
    enlargement: Enlargement | None = None,
) -> Inspected:
    """`diagnose_photo` but for what a hiding JPEG leaves, which a scene pools. `enlargement`: where known."""
    levels = to_levels(image, f"photo {name!r}")
    height, width = levels.shape[:2]
    if low is not None:
        levels = to_levels(low, f"the small photo of {name!r}")
        h, w = levels.shape[:2]
        if h > height or w > width:
            raise ValueError(
                f"the small photo of {name!r} is {w} x {h}, larger than its photo {width} x {height}"
            )
        enlargement = Enlargement(max(1, round(height / h)), None, h, w)
    else:
        enlargement = enlargement or find_enlargement(levels)
        if enlargement.factor > 1:
            levels = undo_enlargement(levels, enlargement.height, enlargement.width)
    jpeg = find_jpeg(levels, path)
    scale = width / levels.shape[1]
    found = PhotoDiagnosis(name, height, width, enlargement, jpeg, None, 0.0, None, LEAST_BLUR * scale)
    if found.hiding:
        return Inspected(found, quantised(levels, np.array(jpeg.table), jpeg.phase))
    if (noise := estimate_noise(levels)) is not None:
        found = replace(found, noise=noise.level, noise_limit=noise.limit)
    if (blur := estimate_blur(levels, found.noise or 0.0)) is not None:
        found = replace(found, blur=_enlarged(blur, scale))
    return Inspected(found, None)


def with_hidden(photo: PhotoDiagnosis, hidden: Hidden | None) -> PhotoDiagnosis:
    """The diagnosis of a photo with a hiding JPEG, completed; under JPEG all blur counts as Gaussian."""
    if hidden is None:
        return photo
    sigma, scale = extra_sigma(hidden.sigma), photo.width / photo.enlargement.width
    return replace(
        photo,
        noise=hidden.noise,
        noise_limit=hidden.noise_limit,
        blur=_enlarged(Blur("gaussian", sigma, sigma, 0.0), scale),
        blur_limit=hidden.sigma_limit * scale,
    )


def _enlarged(blur: Blur, scale: float) -> Blur:
    """The same blur in pixels of the photo after enlargement."""
    return replace(blur, amount=blur.amount * scale, sigma=blur.sigma * scale)
