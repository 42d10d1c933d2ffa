"""Kind and size of a photo's blur from its power spectrum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from hqgs.diagnosis.constants import (
    ANGLES,
    BLUR_LENGTHS,
    BLUR_SIGMAS,
    CLEARLY,
    FINE_LENGTHS,
    FLOOR,
    HIGHEST,
    PLANE_POINTS,
    POINT_ERROR,
    RADII,
    RING_ERROR,
    SHARP,
    SPECTRUM_SLOPE,
    UNKNOWN_FLOORS,
)
from hqgs.diagnosis.spectrum import Fit, Spectrum, fit_blurs, power_spectrum, rings, tile_size
from hqgs.photos.pixels import LUMA_NOISE, Floats, luma

Kind = Literal["gaussian", "defocus", "motion"]

ROUND: tuple[tuple[Kind, Floats], ...] = (("gaussian", BLUR_SIGMAS), ("defocus", RADII))


@dataclass(frozen=True)
class Blur:
    """A photo's blur beyond that of a sharp photo."""

    kind: Kind
    amount: float  # px: sigma (gaussian), radius (defocus) or length (motion)
    sigma: float  # px: of the Gaussian as wide
    confidence: float  # 0..1: that it is this kind
    direction: float | None = None  # of the motion, degrees from x towards y (down), 0..180


def estimate_blur(levels: Floats, noise: float) -> Blur | None:
    """The blur of a photo [H, W, 3] (levels 0..255) with white noise of standard deviation `noise` on top.

    The log power of sharp photos falls linearly in log frequency; Gaussian blur adds -(sigma omega)^2, a disc
    its rings of zeros, a straight motion its parallel stripes. Each kind is fitted with the known noise as
    floor, and only a kind that fits clearly better is preferred to Gaussian. None for a photo below 32 px or
    one in which nothing stands out of the noise.
    """
    grey = luma(levels)
    tile = tile_size(grey)
    if tile is None:
        return None
    spectrum = power_spectrum(grey, tile)
    frequency, log_power = rings(spectrum)
    known = (LUMA_NOISE * noise) ** 2 + FLOOR
    if (log_power > np.log(known) + 1).sum() < 3:  # as many as the law and a blur have unknowns
        return None
    blurs = [_round_blurs(kind, sizes, frequency, spectrum.step) for kind, sizes in ROUND]
    fits = [
        (*(fit_blurs(frequency, log_power, RING_ERROR, blur, floor) for blur in blurs), floor)
        for floor in known + np.array(UNKNOWN_FLOORS)
    ]
    gaussian, defocus, floor = min(fits, key=lambda fit: min(fit[0].cost, fit[1].cost))
    sigma, radius = float(BLUR_SIGMAS[gaussian.best]), float(RADII[defocus.best])
    motion = _motion(spectrum, floor, sigma, radius)
    if motion is not None:
        return motion
    if defocus.cost < CLEARLY * gaussian.cost:
        return Blur("defocus", radius, radius / 2, 1 - defocus.cost / gaussian.cost)
    return Blur("gaussian", extra := extra_sigma(sigma), extra, max(0.0, 1 - gaussian.cost / defocus.cost))


def extra_sigma(sigma: float) -> float:
    """What blur adds to a sharp photo's own softness to make `sigma`, px."""
    return float(np.sqrt(max(sigma**2 - SHARP**2, 0)))


def _motion(spectrum: Spectrum, floor: float, sigma: float, radius: float) -> Blur | None:
    """A straight motion, where it explains the plane of frequencies clearly better than round blurs."""
    at, chosen = _half_plane(spectrum.tile)
    frequency = np.hypot(*at)
    log_power = np.log(spectrum.power.ravel()[chosen] + FLOOR)

    def fit(log_blurs: Floats) -> Fit:
        return fit_blurs(frequency, log_power, POINT_ERROR, log_blurs, floor, steps=4)

    near = np.linspace(0.8, 1.2, 5)
    still = min(
        fit(_round_blurs("gaussian", near * sigma, frequency, spectrum.step)).cost,
        fit(_round_blurs("defocus", near * radius, frequency, spectrum.step)).cost,
    )
    coarse = fit(_coarse_motions(spectrum.tile))
    if coarse.cost >= still:
        return None
    angle = float(np.repeat(ANGLES, len(BLUR_LENGTHS))[coarse.best])
    lengths, angles = (a.ravel() for a in np.meshgrid(FINE_LENGTHS, angle + np.deg2rad([-4.0, 0.0, 4.0])))
    moved = fit(_motions(lengths, angles, at, spectrum.step))
    length = float(lengths[moved.best])
    if moved.cost >= CLEARLY * still:
        return None
    direction = float(np.rad2deg(angles[moved.best]) % 180)
    return Blur("motion", length, length / 12**0.5, 1 - moved.cost / still, direction)


def _round_blurs(kind: Kind, sizes: Floats, frequency: Floats, step: float) -> Floats:
    """Log power responses [sizes, points] of round blurs, as windowed tiles of this step show them."""

    def power(at: Floats) -> Floats:
        if kind == "gaussian":
            return np.exp(-np.square(sizes[:, None] * at)) * at**-SPECTRUM_SLOPE
        x = sizes[:, None] * at
        return np.square(2 * j1(x) / x) * at**-SPECTRUM_SLOPE

    below = np.maximum(frequency - step, step / 4)
    return _leaked(power(frequency), power(below), power(frequency + step), frequency)


def _motions(lengths: Floats, angles: Floats, at: tuple[Floats, Floats], step: float) -> Floats:
    """Log power responses [motions, points] of straight motions at (vertical, horizontal) frequencies."""
    rows, columns = np.sin(angles)[:, None], np.cos(angles)[:, None]

    def power(shift: float) -> Floats:
        vertical, horizontal = at[0] + shift * rows, at[1] + shift * columns
        turns = (vertical * rows + horizontal * columns) * lengths[:, None] / (2 * np.pi)
        distance = np.maximum(np.hypot(vertical, horizontal), step / 4)
        return np.square(np.sinc(turns)) * distance**-SPECTRUM_SLOPE

    return _leaked(power(0), power(-step), power(step), np.hypot(*at))


def _leaked(here: Floats, below: Floats, above: Floats, frequency: Floats) -> Floats:
    """Log of what a Hann window shows of a response: power from the neighbours, by the photos' law."""
    return np.log((here * 2 / 3 + (below + above) / 6) * frequency**SPECTRUM_SLOPE + 1e-7)  # no zero is exact


@lru_cache(maxsize=4)
def _coarse_motions(tile: int) -> Floats:
    angles, lengths = (a.ravel() for a in np.meshgrid(ANGLES, BLUR_LENGTHS, indexing="ij"))
    return _motions(lengths, angles, _half_plane(tile)[0], 2 * np.pi / tile)


@lru_cache(maxsize=4)
def _half_plane(tile: int) -> tuple[tuple[Floats, Floats], NDArray[np.int64]]:
    """Vertical and horizontal frequencies of points spread over half a spectrum, and their flat indices.

    The other half is the mirror image.
    """
    along = (np.arange(tile) - tile // 2) * 2 * np.pi / tile
    vertical, horizontal = (a.ravel() for a in np.meshgrid(along, along, indexing="ij"))
    radius = np.hypot(vertical, horizontal)
    half = (horizontal > 0) | ((horizontal == 0) & (vertical > 0))
    chosen = np.flatnonzero(half & (radius > 2.5 * 2 * np.pi / tile) & (radius < HIGHEST))
    chosen = np.sort(np.random.default_rng(0).permutation(chosen)[:PLANE_POINTS])
    return (vertical[chosen], horizontal[chosen]), chosen
