"""What the choice of photos keeps of each photo's pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.constants import (
    CHOICE_DOUBT,
    CHOICE_SIGMAS,
    FLAT_LEVELS,
    FLAT_SHARE,
    RING_ERROR,
    SPECTRUM_SLOPE,
)
from hqgs.diagnosis.spectrum import fit_blurs, power_spectrum, rings, tile_size
from hqgs.photos.jpeg import blocks_of
from hqgs.photos.pixels import Floats, luma, to_levels
from hqgs.scene.scene import View

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
    return [_summary(photo, view.name, tile) for photo, view in zip(photos, views, strict=True)]


def _summary(photo: NDArray[Any], name: str, tile: int | None) -> PhotoSummary:
    levels = to_levels(photo, f"photo {name!r}")
    grey = luma(levels)
    spread = float(grey.std())
    return PhotoSummary(
        colour=_flat_colour(levels),
        spread=spread,
        rings=None if tile is None else rings(power_spectrum(grey, tile)),
    )


def _flat_colour(levels: Floats) -> Floats | None:
    """The colour [3] of (nearly) all blocks of a photo [H, W, 3]; None where they differ."""
    blocks = blocks_of(levels).mean((1, 2))  # which hides noise
    if not len(blocks):
        return None
    colour = np.median(blocks, axis=0)
    off = np.abs(blocks - colour).max(-1)
    return colour if (off <= FLAT_LEVELS).mean() >= FLAT_SHARE else None


class Sharpness:
    """The power spectra of photos, which tell how sharp each is."""

    def __init__(self, spectra: Sequence[Rings]) -> None:
        """Of N photos, all from tiles of one size."""
        self._frequency = spectra[0][0]
        self._log_power = np.stack([log_power for _, log_power in spectra])  # [N, rings]

    def quarters(self) -> NDArray[np.float64]:
        """[4, N]: the log power of a quarter of the details each, from the coarsest to the finest."""
        return np.stack([part.mean(1) for part in np.array_split(self._log_power, 4, axis=1)])

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
        fit = fit_blurs(self._frequency, mine, RING_ERROR, blurred, float(noise))
        likely = CHOICE_SIGMAS[fit.costs <= fit.cost + CHOICE_DOUBT]
        return float(likely[np.abs(likely).argmin()])
