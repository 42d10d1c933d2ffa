"""Blur and noise under JPEG, from the quantised coefficients alone.

JPEG erases the fine frequencies and adds the borders of its blocks, so a spectrum of the decoded photo tells
nothing. The coefficients tell exactly what is known: each true value lies in a cell of its step's width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.special import ndtr

from hqgs.diagnosis.constants import (
    DCT_LEAST,
    DCT_SLOPE,
    DCT_SLOPE_SPREAD,
    EM_STEPS,
    LEAST_BLUR,
    LIKELIHOOD_GAIN,
    MAGNITUDES,
    SHOWS,
    VARIANCES,
)
from hqgs.photos.jpeg import ENOUGH_BLOCKS, MAX_BLOCKS, block_coefficients
from hqgs.photos.pixels import LUMA_NOISE, Floats, luma

_GRID = (np.arange(-32, 32) + 0.5) * np.pi / 32  # rad/px
_BASIS = np.cos(np.pi * np.arange(8)[:, None] * (2 * np.arange(8) + 1) / 16)
_BASIS[1:] *= np.sqrt(2)
_RESPONSE = np.square(np.abs(_BASIS @ np.exp(-1j * np.outer(np.arange(8), _GRID)))) / (8 * len(_GRID))
_SQUARED = np.square(_GRID[:, None]) + np.square(_GRID)


def _orientations() -> Floats:
    """Classes of blocks by the direction and fineness of what is in them: factors [classes, 63]."""
    rows, columns = (a.ravel()[1:] for a in np.mgrid[:8, :8])
    turn = np.cos(2 * np.arctan2(rows, columns))
    edges = np.exp(np.array([0.0, 0.8, -0.8, 2.0, -2.0])[:, None] * turn)
    texture = np.hypot(rows, columns)[None]
    return np.concatenate([edges, texture])


_CLASSES = _orientations()


@dataclass(frozen=True)
class Hidden:
    """What shows through the JPEG."""

    sigma: float  # px: Gaussian blur, with a sharp photo's own softness
    noise: float  # levels: of white noise in each channel; 0 where it cannot be told from none
    noise_limit: float  # levels: the least noise that would have been told
    sigma_limit: float  # px: below this it could be JPEG alone


def quantised(
    levels: Floats, table: NDArray[np.int64], corner: tuple[int, int] = (0, 0)
) -> NDArray[np.int64]:
    """Coefficients [blocks, 63] of a decoded photo's luma in steps of its `table` [8, 8], means left out."""
    blocks = block_coefficients(luma(levels)[corner[0] :, corner[1] :], MAX_BLOCKS)
    return np.rint(blocks / table).astype(np.int64).reshape(-1, 64)[:, 1:]


def estimate_hidden(steps: NDArray[np.int64], table: NDArray[np.int64]) -> Hidden | None:
    """Blur and noise by maximum likelihood from coefficients `steps` [blocks, 63] of one table [8, 8].

    A block is of one of several classes: how strong, which direction, how fine. Given its class a coefficient
    is Gaussian, its variance the power law of photos times a Gaussian blur's response, seen through the DCT's
    basis functions (which leak: eight pixels are short), plus the noise. The likelihood is that of the cells
    in which the coefficients lie; EM finds how frequent the classes are. Noise must pay for itself: it is
    fitted after the best noiseless model. None for fewer than 40 blocks, or where JPEG left nothing.
    """
    if len(steps) < ENOUGH_BLOCKS or not steps.any():
        return None
    model = _Model(steps, table)
    clean = min((model.minimise([DCT_SLOPE, sigma]) for sigma in (0.5, 2.0)), key=lambda result: result[1])
    noisy = model.minimise([*clean[0], 3.8])
    finest = np.sort(table.ravel()[1:])[:3].mean()
    limit = max(DCT_LEAST, SHOWS * float(finest))
    sigma_limit = LEAST_BLUR + 0.2 * float(np.clip((finest - 30) / 30, 0, 1))
    noise = float(np.exp(noisy[0][2] / 2)) / LUMA_NOISE
    if noise >= limit and clean[1] - noisy[1] >= LIKELIHOOD_GAIN:
        return Hidden(max(float(noisy[0][1]), 0.0), noise, limit, sigma_limit)
    return Hidden(max(float(clean[0][1]), 0.0), 0.0, limit, sigma_limit)


class _Model:
    """The likelihood of a set of blocks."""

    def __init__(self, steps: NDArray[np.int64], table: NDArray[np.int64]) -> None:
        self.table = table.ravel()[1:].astype(np.float64)
        kinds, self.counts = np.unique(
            np.searchsorted(MAGNITUDES, np.abs(steps), side="right"), axis=0, return_counts=True
        )
        self.bins = int(kinds.max()) + 1
        block, coefficient = np.nonzero(kinds)  # the most are zero: their share is the same for every block
        where = coefficient * self.bins + kinds[block, coefficient]
        shape = (len(kinds), 63 * self.bins)
        self.nonzero = csr_array((np.ones(len(block)), (block, where)), shape=shape)
        self.shares = np.full(len(VARIANCES) * len(_CLASSES), 1 / (len(VARIANCES) * len(_CLASSES)))

    def minimise(self, start: list[float]) -> tuple[Floats, float]:
        """Parameters (slope, sigma, and with a third one log noise variance) and the cost there."""
        strides = np.diag([0.3, 0.4, -1.5][: len(start)])
        simplex = np.array(start) + np.concatenate([np.zeros((1, len(start))), strides])
        options = {"xatol": 0.03, "fatol": 0.3, "maxfev": 50 * (len(start) - 1), "initial_simplex": simplex}
        result = minimize(self.cost, start, method="Nelder-Mead", options=options)
        return result.x, float(result.fun)

    def cost(self, parameters: Floats) -> float:
        """Minus the log-likelihood, and what an unusual slope costs."""
        slope, sigma = parameters[:2]
        noise = np.exp(parameters[2]) if len(parameters) == 3 else 1e-2
        power = np.exp(-slope / 2 * np.log(_SQUARED) - max(sigma, 0.0) ** 2 * _SQUARED)
        law = (_RESPONSE @ power @ _RESPONSE.T).ravel()[1:]
        variances = VARIANCES[:, None, None] * (law / law[0]) * _CLASSES
        deviations = np.sqrt(variances.reshape(-1, 63) + noise)
        edges = (MAGNITUDES[: self.bins - 1] - 0.5)[:, None, None] * self.table
        beyond = 2 * ndtr(-edges / deviations)  # [bins - 1, classes, 63]
        cells = np.concatenate([1 - beyond[:1], beyond[:-1] - beyond[1:], beyond[-1:]])
        logs = np.log(np.maximum(cells, 1e-30))
        gains = (logs - logs[0]).transpose(2, 0, 1).reshape(63 * self.bins, -1)
        per_block = self.nonzero @ gains + logs[0].sum(axis=1)
        highest = per_block.max(axis=1, keepdims=True)
        likelihoods = np.exp(per_block - highest)
        # The shares of the last call are nearly those of this one; a little of all keeps each class alive.
        shares = 0.9 * self.shares + 0.1 / len(self.shares)
        for _ in range(EM_STEPS):
            shares = shares * (likelihoods.T @ (self.counts / (likelihoods @ shares))) / self.counts.sum()
        self.shares = shares
        total = ((np.log(likelihoods @ shares) + highest[:, 0]) * self.counts).sum()
        # The law errs alike in all blocks, so its prior counts per block: more blocks must not outvote it.
        unusual = (
            0.5 * self.counts.sum() * ((slope - DCT_SLOPE) / DCT_SLOPE_SPREAD) ** 2
            + 1e3 * min(sigma, 0.0) ** 2
        )
        return float(unusual - total)
