"""How much more a photo is blurred than other photos of the same things."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.blur import RING_ERROR, RING_SAMPLES
from hqgs.diagnosis.levels import Floats
from hqgs.diagnosis.spectrum import SLOPE, fit_blurs

Rings = tuple[Floats, Floats, Floats]  # as `rings` returns them

SIGMAS = np.arange(-3, 10.01, 0.25)  # px; below 0: sharper than the others
DOUBT = 2.0  # of the log-likelihood: two standard deviations
LEAST_SIGNAL = 1e-3  # of the power of details that may be noise alone


class Sharpness:
    """The power spectra of photos, which tell how sharp each is."""

    def __init__(self, spectra: Sequence[Rings]) -> None:
        """Of N photos, all from tiles of one size."""
        self._frequency, _, number = spectra[0]
        self._log_power = np.stack([log_power for _, log_power, _ in spectra])  # [N, rings]
        self._weights = np.minimum(number / RING_SAMPLES, 1) / (2 * RING_ERROR**2)

    def fine(self) -> NDArray[np.float64]:
        """[N]: the log power of the finer half of the details."""
        return np.asarray(self._log_power[:, self._log_power.shape[1] // 2 :].mean(1))

    def extra_blur(self, photo: int, others: NDArray[np.int64]) -> float:
        """Signed sigma (px) of the Gaussian that makes the median spectrum of `others` that of `photo`.

        Contrast and, within limits, the slope of the spectrum are the photo's own. The power of its finest
        details may be noise and does not count as sharpness. When in doubt, the least blur: a photo in which
        little stands out of the noise is not called blurred.
        """
        mine = self._log_power[photo]
        noise = np.exp(mine.min())
        usual = np.exp(np.median(self._log_power[others], axis=0))
        usual = np.log(np.maximum(usual - noise, LEAST_SIGNAL * usual))
        squares = (SIGMAS * np.abs(SIGMAS))[:, None]
        # `fit_blurs` expects a power law: the usual spectrum, as a blur of that law, takes its place.
        blurred = usual + SLOPE * np.log(self._frequency) - squares * self._frequency**2
        fit = fit_blurs(self._frequency, mine, self._weights, blurred, float(noise))
        likely = SIGMAS[fit.costs <= fit.cost + DOUBT]
        return float(likely[np.abs(likely).argmin()])
