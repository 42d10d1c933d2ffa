"""Whether photos differ in sharpness, each in a direction of its own; what is kept of each photo's pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.threads import of_each
from hqgs.diagnosis.blur import (
    LARGEST,
    RING_ERROR,
    SPECTRUM_SLOPE,
    fit_blurs,
    power_spectrum,
    rings,
    tile_size,
)
from hqgs.diagnosis.photo import Finding
from hqgs.photos.jpeg import blocks_of
from hqgs.photos.pixels import Floats, as_floats, luma, to_levels
from hqgs.scene.constants import FEWEST_PHOTOS, MAX_WORKERS
from hqgs.scene.scene import Scene, View

CHOICE_SIGMAS = np.arange(-3, 10.01, 0.25)  # px; below 0: sharper than the others

UNLIKE, TURNED = 0.18, 0.45  # from these values of `unlike_sharpness` on, photos were shaken
SECTORS = 8  # directions of frequencies


Rings = tuple[Floats, Floats]  # as `rings` returns them


@dataclass(frozen=True)
class PhotoSummary:
    """A photo in numbers."""

    colour: Floats | None  # [3] levels, where it shows one colour and, at most, noise
    spread: float  # of the luma, levels: standard deviation
    rings: Rings | None  # of its spectrum; None: a photo of the scene is too small for one


def summarised(views: Sequence[View]) -> list[PhotoSummary]:
    """One for each view; of the small photos, where all views have them: enlargement adds nothing.

    ValueError for values that are not finite; it names the photo.
    """
    photos: list[NDArray[Any]] = [view.image if view.low is None else view.low for view in views]
    factors = {view.image.shape[0] // small.shape[0] for view, small in zip(views, photos, strict=True)}
    if len(factors) > 1:
        photos = [view.image for view in views]
    tiles = [tile_size(photo[..., 0]) for photo in photos]
    known = [tile for tile in tiles if tile is not None]
    # One size for all, so that their frequencies are the same.
    tile = min(known) if len(known) == len(views) > 0 else None

    def summary(number: int) -> PhotoSummary:
        levels = to_levels(photos[number], f"photo {views[number].name!r}")
        grey = luma(levels)
        spectrum = None if tile is None else rings(power_spectrum(grey, tile))
        return PhotoSummary(_flat_colour(levels), float(grey.std()), spectrum)

    return list(of_each(summary, range(len(views)), MAX_WORKERS))


def _flat_colour(levels: Floats) -> Floats | None:
    """The colour [3] of (nearly) all blocks of a photo [H, W, 3]; None where they differ."""
    blocks = blocks_of(levels).mean((1, 2))  # which hides noise
    if not len(blocks):
        return None
    colour = np.median(blocks, axis=0)
    off = np.abs(blocks - colour).max(-1)
    # that a block may be off the colour of an empty photo
    return colour if (off <= 3.0).mean() >= 0.99 else None  # of the blocks of an empty photo


class Sharpness:
    """The power spectra of photos, which tell how sharp each is."""

    def __init__(self, spectra: Sequence[Rings]) -> None:
        """Of N photos, all from tiles of one size."""
        self._frequency = spectra[0][0]
        self._log_power = np.stack([log_power for _, log_power in spectra])  # [N, rings]

    def extra_blur(self, photo: int, others: NDArray[np.int64]) -> float:
        """Signed sigma (px) of the Gaussian that makes the median spectrum of `others` that of `photo`.

        Contrast and, within limits, the slope of the spectrum are the photo's own. The power of its finest
        details may be noise and does not count as sharpness. When in doubt, the least blur: a photo in which
        little stands out of the noise is not called blurred.
        """
        mine = self._log_power[photo]
        noise = np.exp(mine.min())
        usual = np.exp(np.median(self._log_power[others], axis=0))
        usual = np.log(np.maximum(usual - noise, 1e-3 * usual))
        squares = (CHOICE_SIGMAS * np.abs(CHOICE_SIGMAS))[:, None]
        # `fit_blurs` expects a power law: the usual spectrum, as a blur of that law, takes its place.
        blurred = usual + SPECTRUM_SLOPE * np.log(self._frequency) - squares * self._frequency**2
        costs = fit_blurs(self._frequency, mine, RING_ERROR, blurred, float(noise))
        likely = CHOICE_SIGMAS[costs <= costs.min() + 2.0]  # of the log-likelihood: two standard deviations
        return float(likely[np.abs(likely).argmin()])


def unlike_sharpness(scene: Scene) -> tuple[float, float] | None:
    """How training photos differ in the logarithms of their power spectra, standard deviations over photos:
    by how much more in fine details than in coarse ones; and in the directions of the finer details, less
    each mean. None where they are too few or too small to tell.

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
    log_power = np.stack([log_power for _, log_power in rings])
    # [4, N]: of a quarter of the details each, from the coarsest to the finest
    quarters = np.stack([part.mean(1) for part in np.array_split(log_power, 4, axis=1)])
    directions = np.stack([*of_each(_directions, [view.image for view in scene.train])])
    faces = np.array([view.face for view in scene.train])
    for face in np.unique(faces):
        alike = faces == face
        if not alike.all():
            quarters[:, alike] -= np.median(quarters[:, alike], axis=1, keepdims=True)
        directions[alike] -= np.median(directions[alike], axis=0)
    coarse, *finer = quarters.std(axis=1)
    directions -= directions.mean(1, keepdims=True)
    return float(max(finer) - coarse), float(directions.std())


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

    return logs((0.15, 0.4)) - logs((0.03, 0.1))  # of frequencies, cycles per px


def shake_finding(scene: Scene) -> Finding:
    unlike = unlike_sharpness(scene)
    if unlike is None:
        return Finding("shake", "not measured: the photos are too few or too small")
    sharpness, direction = unlike
    reason = f"photos differ by {sharpness:.2f} in sharpness, by {direction:.2f} in its direction"
    if sharpness < UNLIKE or direction < TURNED:
        reason += f" (needed from {UNLIKE:g} and {TURNED:g}, in the logarithm of the power of fine details)"
        return Finding("shake", reason, None, sharpness)
    return Finding("shake", reason, "shake", sharpness)
