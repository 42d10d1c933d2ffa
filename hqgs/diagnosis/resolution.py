"""Was a photo enlarged, and by how much?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from hqgs.photos.pixels import Floats, luma
from hqgs.photos.resize import resize_matrix
from hqgs.scene.constants import SMALLEST_SIDE

FACTORS = (2, 3, 4, 6, 8)  # of enlargement that are tried
LONGEST = 768  # px of a line that are looked at
ROUNDING = 0.05  # levels; a residual below this counts as this


@dataclass(frozen=True)
class Enlargement:
    """A photo's factor of enlargement; 1 for none."""

    factor: int
    evidence: float | None  # how much worse a grid off by half a period explains the photo; None: it is known
    height: int  # of the photo before it was enlarged, px
    width: int


def find_enlargement(levels: Floats) -> Enlargement:
    """Whether bicubic enlargement by a factor in `FACTORS` made this photo [H, W, 3] (levels 0..255).

    Every line of an enlarged photo lies in the space that the enlargement matrix spans, and the grid of its
    small pixels has a phase. The measure is the part of the lines outside that space, for the grid shifted by
    half a period over that for the grid in place: a photo that is merely smooth gives 1 at every factor.
    (Gallagher 2005 and Mahdian & Saic 2008 see the same period in the variance of second differences.) Both
    axes must agree. Bilinear and Lanczos enlargement show too, more weakly.
    """
    height, width = levels.shape[:2]
    grey = luma(levels)
    candidates: list[tuple[float, int, int, int]] = []
    for factor in FACTORS:  # every fourth line tells as much as all
        rows = _best_size(grey[:, ::4], factor)
        columns = _best_size(grey.T[:, ::4], factor)
        candidates.append((min(rows[0], columns[0]), factor, rows[1], columns[1]))
    evidence, factor, small_height, small_width = max(candidates)
    if evidence < 2.1:  # JPEG blocks reach 1.8 at factor 2; bicubic enlargement kept in 8 bits starts at 4.5
        return Enlargement(1, evidence, height, width)
    return Enlargement(factor, evidence, small_height, small_width)


def undo_enlargement(levels: Floats, height: int, width: int) -> Floats:
    """The photo [height, width, 3] whose bicubic enlargement comes nearest to `levels` (least squares)."""
    tall = _solve(levels, height)  # [height, W, 3]
    return _solve(tall.swapaxes(0, 1), width).swapaxes(0, 1)


def _best_size(lines: Floats, factor: int) -> tuple[float, int]:
    """Evidence and small size for lines along axis 0; sizes may have been rounded up or down."""
    size = len(lines)
    sizes = {-(-size // factor), size // factor}
    return max((_evidence(lines, small, factor), small) for small in sizes)


def _evidence(lines: Floats, small: int, factor: int) -> float:
    if small < SMALLEST_SIDE:
        return 0.0
    basis = _basis(small, len(lines))
    lines = lines[: len(basis)]
    shift = factor // 2
    shifted = np.concatenate([lines[shift:], lines[::-1][:shift]])
    inside = slice(3 * factor, -3 * factor)  # away from the border that the shift made up
    in_place, off = (
        np.sqrt(np.square((part - basis @ (basis.T @ part))[inside]).mean()) for part in (lines, shifted)
    )
    return float(off / max(in_place, ROUNDING)) if off > ROUNDING else 0.0


@lru_cache(maxsize=32)
def _basis(small: int, size: int) -> Floats:
    """Orthonormal columns that span the first pixels of enlarged lines, [pixels, small pixels]."""
    matrix = resize_matrix(small, size)[:LONGEST]
    return np.linalg.qr(matrix[:, matrix.any(axis=0)])[0]


def _solve(levels: Floats, small: int) -> Floats:
    """The [small, ...] whose enlargement along axis 0 comes nearest to `levels`, by the normal equations."""
    matrix = csc_array(resize_matrix(small, len(levels)))
    right = matrix.T @ levels.reshape(len(levels), -1)
    return splu((matrix.T @ matrix).tocsc()).solve(right).reshape(small, *levels.shape[1:])
