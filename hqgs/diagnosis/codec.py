"""What codecs leave in a photo: blocks and tables of JPEG, blur and noise under it, the levels of a film.

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

from hqgs.diagnosis.blur import LEAST_BLUR
from hqgs.photos.jpeg import ENOUGH_BLOCKS, MAX_BLOCKS, block_coefficients, fine_detail, standard_tables
from hqgs.photos.pixels import LUMA, LUMA_NOISE, Floats, luma

SPREAD = 0.4  # levels: standard deviation of a decoded coefficient, as pixels were rounded twice
OUTLIERS = 0.02  # share of coefficients off the comb, in blocks that were clipped
STEPS = 255  # the largest step of an 8-bit JPEG

DCT_SLOPE, DCT_SLOPE_SPREAD = 2.55, 2.0  # of the power over frequency; the spread is that of one block
VARIANCES = 13 * 6.0 ** np.arange(-1, 8)  # levels^2: of the lowest coefficient, one per class of blocks
MAGNITUDES = np.array([1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40, 56, 80, 112, 160, 226, 320, 452])  # in steps

LUMA_709 = np.array([0.2126, 0.7152, 0.0722])  # of films in HD (ITU-R BT.709); LUMA is that of the others
STEP = 255 / 219  # levels: of the luma of 8 bits from 16 (black) to 235 (white), which films store


_ROWS, _COLUMNS = np.mgrid[:6, :6]
_WAVES = _ROWS + _COLUMNS
# Rows and columns of the 20 low frequencies. Not the mean: in a flat photo it is the same in all blocks.
LOW = (_ROWS[(_WAVES > 0) & (_WAVES < 6)], _COLUMNS[(_WAVES > 0) & (_WAVES < 6)])


@dataclass(frozen=True)
class Jpeg:
    """JPEG as a photo shows it. `quality` None: no comb in its coefficients."""

    quality: int | None  # of libjpeg, 1..100
    blocking: float  # steps across the borders of 8 x 8 blocks over those inside, minus 1
    phase: tuple[int, int]  # row and column of the first block border, 0..7
    # [8, 8] of the luma, steps in 1/255. Of a table that is not libjpeg's only the low frequencies show; the
    # rest, and the mean's step, are then those of the nearest quality.
    table: tuple[tuple[int, ...], ...] | None


def find_jpeg(levels: Floats) -> Jpeg:
    """JPEG traces in a photo [H, W, 3] (levels 0..255) that was not resized after decoding.

    In a decoded photo each coefficient of an 8 x 8 block lies near a multiple of its step (Fan & de Queiroz
    2003). A step's comb is scored by its log-likelihood over the smooth density that the coefficients come
    from, summed over the low frequencies. Candidates are libjpeg's 100 tables, and the best step of each
    frequency by itself, which pays for its freedom.
    """
    grey = luma(levels)
    blocking, phase = measure_blocking(grey)
    if min(grey.shape) < 3 * 8:  # too few blocks
        return Jpeg(None, blocking, phase, None)
    in_range = np.all((levels > 0) & (levels < 255), axis=2)
    # above this a grid that does not begin at the corner is looked at too
    for row, column in dict.fromkeys([(0, 0), phase] if blocking > 0.15 else [(0, 0)]):
        # looked at; they are spread over the photo
        coefficients = block_coefficients(grey[row:, column:], 200, in_range[row:, column:])
        quality, table = _best_table(coefficients)
        if quality is not None:
            steps = tuple(tuple(int(step) for step in line) for line in table)
            return Jpeg(quality, blocking, (row, column), steps)
    return Jpeg(None, blocking, phase, None)


def measure_blocking(grey: Floats) -> tuple[float, tuple[int, int]]:
    """Blocking strength of a luma [H, W] and the phase (row, column) of the first border of 8 x 8 blocks.

    Per axis: the mean step between neighbours at each of the 8 phases; the largest over the median, minus 1.
    The strength is the smaller of the two axes'.
    """
    strengths, phases = [], []
    for steps in (np.abs(np.diff(grey, axis=0)).mean(1), np.abs(np.diff(grey, axis=1)).mean(0)):
        if len(steps) < 16:
            return 0.0, (0, 0)
        means = np.array([steps[k::8].mean() for k in range(8)])
        strengths.append(float((means.max() - np.median(means)) / max(np.median(means), 0.1)))
        phases.append((int(means.argmax()) + 1) % 8)
    return min(strengths), (phases[0], phases[1])


def _best_table(coefficients: Floats) -> tuple[int | None, NDArray[np.int64]]:
    """Quality (None: not proven) and table [8, 8] that best explain coefficients [n, 8, 8]."""
    scores, count = _comb_scores(coefficients)
    tables = standard_tables()
    totals = _total(scores, tables)
    best = int(totals.argmax())
    candidates = [(best + 1, tables[best], totals[best])]
    told = scores.max(axis=1) > np.log(STEPS)  # frequencies whose coefficients pay for a free choice
    if told.any():
        at = (LOW[0][told], LOW[1][told])
        steps = scores[told].argmax(axis=1) + 1
        ratios = np.abs(np.log(tables[:, at[0], at[1]] / steps)).mean(1)
        quality = int(ratios.argmin()) + 1  # nearest by ratio
        free = tables[quality - 1].copy()
        free[at] = steps
        candidates.append((quality, free, _total(scores, free[None])[0] - len(steps) * np.log(STEPS)))
    quality, table, total = max(candidates, key=lambda candidate: candidate[2])  # the first of equals
    # in which coefficients must show: few repeat in a drawing
    many = count >= ENOUGH_BLOCKS and (scores != 0).any(axis=1).sum() >= 4
    # nats per coefficient; photos that were never JPEG have -0.25, quality 90 has 0.8
    return (quality if many and total / count >= 0.5 else None), table


def _comb_scores(coefficients: Floats) -> tuple[Floats, int]:
    """Scores [low frequencies, steps 1..STEPS] of coefficients [n, 8, 8], and how many are not near zero.

    A score is the log-likelihood under the step's comb over that under the smooth density. A comb of step q
    holds q times the density at its teeth, so a step that divides the true one gains less.
    """
    steps = np.arange(1, STEPS + 1)
    scores, count = np.zeros((len(LOW[0]), STEPS)), 0
    for k, values in enumerate(coefficients[:, LOW[0], LOW[1]].T):
        values = values[np.abs(values) > 5 * SPREAD, None]
        off = values - steps * np.rint(values / steps)
        teeth = steps * np.exp(-0.5 * np.square(off / SPREAD)) / (SPREAD * np.sqrt(2 * np.pi))
        scores[k] = np.log(OUTLIERS + (1 - OUTLIERS) * teeth).sum(axis=0)
        count += len(values)
    return scores, count


def _total(scores: Floats, tables: NDArray[np.int64]) -> Floats:
    """The score of each table [n, 8, 8]; [n]."""
    steps = tables[:, LOW[0], LOW[1]].clip(1, STEPS)
    return np.take_along_axis(scores.T, steps - 1, axis=0).sum(axis=1)


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
    # times the mean of the three finest steps: the least noise that is told from fine texture
    limit = max(6.0, 0.32 * float(finest))  # levels; below it fine texture is taken for noise at any table
    sigma_limit = LEAST_BLUR + 0.2 * float(np.clip((finest - 30) / 30, 0, 1))
    noise = float(np.exp(noisy[0][2] / 2)) / LUMA_NOISE
    if noise >= limit and clean[1] - noisy[1] >= 8.0:  # nats that noise must bring, or there is none
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
        for _ in range(12):  # rounds of expectation and maximisation over the classes of blocks
            shares = shares * (likelihoods.T @ (self.counts / (likelihoods @ shares))) / self.counts.sum()
        self.shares = shares
        total = ((np.log(likelihoods @ shares) + highest[:, 0]) * self.counts).sum()
        # The law errs alike in all blocks, so its prior counts per block: more blocks must not outvote it.
        unusual = (
            0.5 * self.counts.sum() * ((slope - DCT_SLOPE) / DCT_SLOPE_SPREAD) ** 2
            + 1e3 * min(sigma, 0.0) ** 2
        )
        return float(unusual - total)


def film_detail(levels: Floats) -> float | None:
    """The `fine_detail` that a film's codec left in a frame [H, W, 3] of levels 0..255; None: no such frame.

    A frame that was decoded, and neither resized nor compressed since, has a luma of whole steps of `STEP`
    levels, but for the rounding of its colours, which blurs them by 0.19 levels.
    """
    # decoded frames have 0.48 and more, frames made smaller since 0.15 at most, photos 0.02
    if max(_comb(levels @ weights) for weights in (LUMA, LUMA_709)) < 0.35:
        return None
    return fine_detail(levels)


def _comb(grey: Floats) -> float:
    """How near a luma lies to whole steps of films: 1 if on them, 0 if it does not care.

    A mean over the levels that it has, so that a large plain area counts no more than its level.
    """
    level = np.rint(grey.clip(0, 255)).astype(np.int64).ravel()
    pixels = np.bincount(level, minlength=256)
    told = pixels >= 10  # of each level that counts
    told[[0, -1]] = False  # what is clipped
    if told.sum() < 48:  # such levels
        return 0.0
    near = np.bincount(level, np.cos(2 * np.pi / STEP * grey).ravel(), len(pixels))
    return float((near[told] / pixels[told]).mean())
