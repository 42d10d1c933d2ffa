"""Power spectrum of a photo and the law that photos follow: power falls like 1 / frequency^a."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2

from hqgs.diagnosis.constants import (
    FLOOR,
    HIGHEST,
    LARGEST_TILE,
    MOST_TILES,
    NEWTON_STEPS,
    SHARED_TILES,
    SMALLEST_TILE,
    SPECTRUM_SLOPE,
    SPECTRUM_SLOPE_SPREAD,
)
from hqgs.photos.pixels import Floats


@dataclass(frozen=True)
class Spectrum:
    """Mean power of a photo's windowed tiles, levels^2 per pixel, at centred frequencies."""

    power: Floats  # [T, T]; zero frequency at [T // 2, T // 2]
    tile: int  # T, even

    @property
    def step(self) -> float:
        """Between frequencies, rad/px."""
        return 2 * np.pi / self.tile

    def frequencies(self) -> tuple[Floats, Floats]:
        """Vertical [T, 1] and horizontal [1, T] frequencies, rad/px."""
        along = (np.arange(self.tile) - self.tile // 2) * self.step
        return along[:, None], along[None]


@dataclass(frozen=True)
class Fit:
    """How well each of several blurs explains a spectrum."""

    costs: Floats  # [blurs]: weighted squares of the log power's misfit and of the slope's oddness

    @property
    def best(self) -> int:
        return int(self.costs.argmin())

    @property
    def cost(self) -> float:
        return float(self.costs.min())


def tile_size(grey: Floats) -> int | None:
    """Side of the tiles for a luma [H, W]; None for a photo too small for any."""
    short = min(grey.shape)
    if short < SMALLEST_TILE:
        return None
    return int(np.clip(short // SHARED_TILES, SMALLEST_TILE, LARGEST_TILE)) // 2 * 2


def power_spectrum(grey: Floats, tile: int) -> Spectrum:
    """Welch's estimate for a luma [H, W]: the mean over Hann-windowed tiles, which overlap by half
    unless there are too many."""
    window = np.hanning(tile + 2)[1:-1]
    window = window[:, None] * window
    rows, columns = (_starts(size, tile) for size in grey.shape)
    total = np.zeros((tile, tile))
    for row in rows:
        tiles = np.stack([grey[row : row + tile, column : column + tile] for column in columns])
        tiles = tiles - (tiles * window).sum(axis=(1, 2), keepdims=True) / window.sum()
        total += np.square(np.abs(np.asarray(fft2((tiles * window).astype(np.float32))))).sum(axis=0)
    power = total / (len(rows) * len(columns) * np.square(window).sum())
    return Spectrum(np.fft.fftshift(power), tile)


def rings(spectrum: Spectrum) -> tuple[Floats, Floats]:
    """Mean frequency (rad/px) and mean log power of rings one step wide; each [rings]."""
    vertical, horizontal = spectrum.frequencies()
    radius = np.hypot(vertical, horizontal).ravel()
    ring = np.rint(radius / spectrum.step).astype(np.int64)
    count = int(HIGHEST / spectrum.step) + 1
    inside = ring < count
    number = np.bincount(ring[inside], minlength=count).astype(np.float64)
    log_power = np.log(spectrum.power.ravel()[inside] + FLOOR)
    means = (np.bincount(ring[inside], x, count) / number for x in (radius[inside], log_power))
    first = 2 if spectrum.tile < 100 else 3  # the lowest rings hold few samples and the window's leakage
    frequency, power = (mean[first:] for mean in means)
    return frequency, power


def fit_blurs(
    frequency: Floats,
    log_power: Floats,
    error: float,
    log_blurs: Floats,
    noise: float,
    steps: int = NEWTON_STEPS,
) -> Fit:
    """Fit `log(exp(c) frequency^-a blur + noise)` to `log_power` for each blur; [points], blurs [B, points].

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
    return Fit((weight * misfit**2).sum(1) + stiffness * (slope - SPECTRUM_SLOPE) ** 2)


def _starts(size: int, tile: int) -> NDArray[np.int64]:
    count = min(int(np.ceil((size - tile) / (tile / 2))) + 1, MOST_TILES)
    return np.unique(np.rint(np.linspace(0, size - tile, count)).astype(np.int64))
