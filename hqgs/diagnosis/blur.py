"""Kind and size of a photo's blur from its power spectrum, by the law that photos follow: power falls like
1 / frequency^a.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2
from scipy.special import j1

from hqgs.photos.pixels import LUMA_NOISE, Floats, luma

LARGEST = 1024  # px a side: more of the middle of a photo is not looked at, but for its enlargement
LEAST_BLUR = 0.7  # px, a Gaussian's sigma; photos that count as sharp reach 0.6, at JPEG's quality 10 0.8
FLOOR = 0.03  # levels^2: what rounding to 8 bits leaves in the luma; nothing below it is believed
SPECTRUM_SLOPE, SPECTRUM_SLOPE_SPREAD = 2.4, 0.35  # of the power, over photos that count as sharp
SMALLEST_TILE, LARGEST_TILE = 32, 128  # px
HIGHEST = 2.7  # rad/px; above it cameras and resizing leave their own mark

BLUR_SIGMAS = np.concatenate([np.arange(0, 4, 0.05), 4 * 1.02 ** np.arange(70)])  # px, up to 16
RADII = np.concatenate([np.arange(1, 8, 0.1), 8 * 1.02 ** np.arange(57)])  # px of the disc, up to 24
BLUR_LENGTHS = 3 * 1.25 ** np.arange(13)  # px, of the motion
ANGLES = np.arange(18) * np.pi / 18  # rad, of the motion
CLEARLY = 0.7  # a kind other than Gaussian must have less than this share of the Gaussian's misfit
# Of the log power: how far sharp photos are off the law; as points err together, each tells little.
RING_ERROR, POINT_ERROR = 0.2, 0.6


def tile_size(grey: Floats) -> int | None:
    """Side of the tiles for a luma [H, W]; None for a photo too small for any."""
    short = min(grey.shape)
    if short < SMALLEST_TILE:
        return None
    # tiles along the shorter side, before their overlap
    return int(np.clip(short // 3, SMALLEST_TILE, LARGEST_TILE)) // 2 * 2


def power_spectrum(grey: Floats, tile: int) -> Floats:
    """Welch's estimate for a luma [H, W]: mean power, levels^2 per pixel, [T, T], of Hann-windowed tiles of
    an even side T, which overlap by half unless there are too many; zero frequency at [T // 2, T // 2]."""
    window = np.hanning(tile + 2)[1:-1]
    window = window[:, None] * window
    rows, columns = (_starts(size, tile) for size in grey.shape)
    total = np.zeros((tile, tile))
    for row in rows:
        tiles = np.stack([grey[row : row + tile, column : column + tile] for column in columns])
        tiles = tiles - (tiles * window).sum(axis=(1, 2), keepdims=True) / window.sum()
        total += np.square(np.abs(np.asarray(fft2((tiles * window).astype(np.float32))))).sum(axis=0)
    return np.fft.fftshift(total / (len(rows) * len(columns) * np.square(window).sum()))


def rings(spectrum: Floats) -> tuple[Floats, Floats]:
    """Mean frequency (rad/px) and mean log power of rings one step wide; each [rings]."""
    tile = len(spectrum)
    step = 2 * np.pi / tile  # between frequencies, rad/px
    along = (np.arange(tile) - tile // 2) * step
    radius = np.hypot(along[:, None], along[None]).ravel()
    ring = np.rint(radius / step).astype(np.int64)
    count = int(HIGHEST / step) + 1
    inside = ring < count
    number = np.bincount(ring[inside], minlength=count).astype(np.float64)
    log_power = np.log(spectrum.ravel()[inside] + FLOOR)
    means = (np.bincount(ring[inside], x, count) / number for x in (radius[inside], log_power))
    first = 2 if tile < 100 else 3  # the lowest rings hold few samples and the window's leakage
    frequency, power = (mean[first:] for mean in means)
    return frequency, power


def fit_blurs(
    frequency: Floats,
    log_power: Floats,
    error: float,
    log_blurs: Floats,
    noise: float,
    steps: int = 8,  # of the fit of the law
) -> Floats:
    """Fit `log(exp(c) frequency^-a blur + noise)` to `log_power` for each blur; [points], blurs [B, points].

    Returns what each costs, [B]: weighted squares of the log power's misfit and of the slope's oddness.

    `error`: standard deviation of the log power. `log_blurs` are log power responses, `noise` the power of
    what was not blurred. Amplitude c is free, slope a is held near its usual value (SPECTRUM_SLOPE): so a
    blur is told from a soft scene. Gauss-Newton.
    """
    log_frequency, log_noise = np.log(frequency), np.log(noise)
    slope = np.full(len(log_blurs), SPECTRUM_SLOPE)
    height = np.full(len(log_blurs), np.median(log_power[:3] + SPECTRUM_SLOPE * log_frequency[:3]))
    weight, stiffness = 1 / (2 * error**2), 1 / SPECTRUM_SLOPE_SPREAD**2

    def predict() -> tuple[Floats, Floats]:
        signal = height[:, None] - slope[:, None] * log_frequency + log_blurs
        return signal, np.maximum(signal, log_noise) + np.log1p(np.exp(-np.abs(signal - log_noise)))

    for _ in range(steps):
        signal, model = predict()
        misfit = log_power - model
        share = np.exp(signal - model)  # of the signal in the power: the derivative by c
        w = weight * share * share
        h11, h12 = w.sum(1), -(w * log_frequency).sum(1)
        h22 = (w * log_frequency**2).sum(1) + stiffness
        g1 = (weight * share * misfit).sum(1)
        g2 = -(weight * share * misfit * log_frequency).sum(1) + stiffness * (SPECTRUM_SLOPE - slope)
        determinant = h11 * h22 - h12**2
        height += ((h22 * g1 - h12 * g2) / determinant).clip(-3, 3)
        slope += ((h11 * g2 - h12 * g1) / determinant).clip(-0.7, 0.7)
    misfit = log_power - predict()[1]
    return (weight * misfit**2).sum(1) + stiffness * (slope - SPECTRUM_SLOPE) ** 2


def _starts(size: int, tile: int) -> NDArray[np.int64]:
    count = min(int(np.ceil((size - tile) / (tile / 2))) + 1, 12)  # along a side of a large photo
    return np.unique(np.rint(np.linspace(0, size - tile, count)).astype(np.int64))


Kind = Literal["gaussian", "defocus", "motion"]

ROUND: tuple[tuple[Kind, Floats], ...] = (("gaussian", BLUR_SIGMAS), ("defocus", RADII))


@dataclass(frozen=True)
class Blur:
    """A photo's blur beyond that of a sharp photo."""

    kind: Kind
    amount: float  # px: sigma (gaussian), radius (defocus) or length (motion)
    sigma: float  # px: of the Gaussian as wide
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
    blurs = [_round_blurs(kind, sizes, frequency, 2 * np.pi / tile) for kind, sizes in ROUND]
    # levels^2: what JPEG of a quality too good to be found may have added; without them a blur of 2 px under
    # quality 95 passes for a disc, one of 1 px under 92 for 0.7 px.
    fits = [
        (*(fit_blurs(frequency, log_power, RING_ERROR, blur, floor) for blur in blurs), floor)
        for floor in known + np.array([0.0, 0.1, 0.3, 1.0])
    ]
    gaussian, defocus, floor = min(fits, key=lambda fit: min(fit[0].min(), fit[1].min()))
    sigma, radius = float(BLUR_SIGMAS[gaussian.argmin()]), float(RADII[defocus.argmin()])
    motion = _motion(spectrum, floor, sigma, radius)
    if motion is not None:
        return motion
    if defocus.min() < CLEARLY * gaussian.min():
        return Blur("defocus", radius, radius / 2)
    return Blur("gaussian", extra := extra_sigma(sigma), extra)


def extra_sigma(sigma: float) -> float:
    """What blur adds to a sharp photo's own softness to make `sigma`, px."""
    # px: the sigma that the spectra of sharp photos fit; taken off in squares
    return float(np.sqrt(max(sigma**2 - 0.3**2, 0)))


def _motion(spectrum: Floats, floor: float, sigma: float, radius: float) -> Blur | None:
    """A straight motion, where it explains the plane of frequencies clearly better than round blurs."""
    at, chosen = _half_plane(len(spectrum))
    step = 2 * np.pi / len(spectrum)
    frequency = np.hypot(*at)
    log_power = np.log(spectrum.ravel()[chosen] + FLOOR)

    def fit(log_blurs: Floats) -> Floats:
        return fit_blurs(frequency, log_power, POINT_ERROR, log_blurs, floor, steps=4)

    near = np.linspace(0.8, 1.2, 5)
    still = min(
        fit(_round_blurs("gaussian", near * sigma, frequency, step)).min(),
        fit(_round_blurs("defocus", near * radius, frequency, step)).min(),
    )
    coarse = fit(_coarse_motions(len(spectrum)))
    if coarse.min() >= still:
        return None
    angle = float(np.repeat(ANGLES, len(BLUR_LENGTHS))[coarse.argmin()])
    fine = 3 * 1.04 ** np.arange(69), angle + np.deg2rad([-4.0, 0.0, 4.0])  # px and rad, around the best
    lengths, angles = (a.ravel() for a in np.meshgrid(*fine))
    moved = fit(_motions(lengths, angles, at, step))
    length = float(lengths[moved.argmin()])
    if moved.min() >= CLEARLY * still:
        return None
    direction = float(np.rad2deg(angles[moved.argmin()]) % 180)
    return Blur("motion", length, length / 12**0.5, direction)


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
    # frequencies at which motion is looked for
    chosen = np.sort(np.random.default_rng(0).permutation(chosen)[:1_000])
    return (vertical[chosen], horizontal[chosen]), chosen
