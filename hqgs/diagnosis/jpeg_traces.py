"""Traces of JPEG: the blocks, and the quantisation table that the coefficients still show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.constants import (
    BLOCKING_SEEN,
    COMB_MAX_BLOCKS,
    COMB_MIN_EVIDENCE,
    MIN_FREQUENCIES,
    OUTLIERS,
    SPREAD,
    STEPS,
)
from hqgs.photos.jpeg import ENOUGH_BLOCKS, block_coefficients, standard_tables
from hqgs.photos.pixels import Floats, luma

_ROWS, _COLUMNS = np.mgrid[:6, :6]
_WAVES = _ROWS + _COLUMNS
# Rows and columns of the 20 low frequencies. Not the mean: in a flat photo it is the same in all blocks.
LOW = (_ROWS[(_WAVES > 0) & (_WAVES < 6)], _COLUMNS[(_WAVES > 0) & (_WAVES < 6)])


@dataclass(frozen=True)
class Jpeg:
    """JPEG as a photo shows it. `quality` None: no comb in its coefficients."""

    quality: int | None  # of libjpeg, 1..100
    evidence: float  # mean gain in log-likelihood per coefficient that is not zero, nats
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
        return Jpeg(None, 0.0, blocking, phase, None)
    in_range = np.all((levels > 0) & (levels < 255), axis=2)
    unproven = []
    for row, column in dict.fromkeys([(0, 0), phase] if blocking > BLOCKING_SEEN else [(0, 0)]):
        coefficients = block_coefficients(grey[row:, column:], COMB_MAX_BLOCKS, in_range[row:, column:])
        quality, evidence, table = _best_table(coefficients)
        if quality is not None:
            steps = tuple(tuple(int(step) for step in line) for line in table)
            return Jpeg(quality, evidence, blocking, (row, column), steps)
        unproven.append(evidence)
    return Jpeg(None, max(unproven), blocking, phase, None)


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


def _best_table(coefficients: Floats) -> tuple[int | None, float, NDArray[np.int64]]:
    """Quality (None: not proven), its evidence and table [8, 8] that best explain coefficients [n, 8, 8]."""
    scores, count = _comb_scores(coefficients)
    tables = standard_tables()
    totals = _total(scores, tables)
    best = int(totals.argmax())
    candidates = [(best + 1, tables[best], totals[best])]
    told = scores.max(axis=1) > np.log(STEPS)  # frequencies whose coefficients pay for a free choice
    if told.any():
        at = (LOW[0][told], LOW[1][told])
        steps = scores[told].argmax(axis=1) + 1
        quality = (
            int(np.abs(np.log(tables[:, at[0], at[1]] / steps)).mean(1).argmin()) + 1
        )  # nearest by ratio
        free = tables[quality - 1].copy()
        free[at] = steps
        candidates.append((quality, free, _total(scores, free[None])[0] - len(steps) * np.log(STEPS)))
    quality, table, total = max(candidates, key=lambda candidate: candidate[2])  # the first of equals
    evidence = float(total / max(count, 1))
    many = count >= ENOUGH_BLOCKS and (scores != 0).any(axis=1).sum() >= MIN_FREQUENCIES
    proven = many and evidence >= COMB_MIN_EVIDENCE
    return (quality if proven else None), evidence, table


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
