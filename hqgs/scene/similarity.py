"""The similarity between two frames, from points that both have, some of which may be wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import combinations
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.constants import OUTLIER, ROUNDING

Array = NDArray[np.float64]
Rows = NDArray[np.intp] | NDArray[np.bool_]
Fit = TypeVar("Fit")


def similarity(source: Array, target: Array, turns: Array | None = None) -> tuple[float, Array, Array] | None:
    """Scale, rotation [3, 3] and shift [3] that take source [N, 3] to target in least squares (Umeyama 1991).

    `turns` [M, 3, 3]: rotations that are also told, by orientations, and count a little: points on a line, or
    two, are enough with them. None where all are one point or the scale is not above 0, and without `turns`
    where the source lies on a line, so that any turn about it would do.
    """
    middle, aim = source.mean(0), target.mean(0)
    a, b = source - middle, target - aim
    lengths = [float(np.linalg.norm(x)) for x in (a, b)]
    if any(
        length <= ROUNDING * float(np.abs(x).max())
        for length, x in zip(lengths, (source, target), strict=True)
    ):
        return None
    own = np.linalg.svd(a, compute_uv=False)
    if turns is None and not own[1] > 1e-3 * own[0]:
        return None
    told = 0.0 if turns is None else 0.1 * turns.mean(0)  # decides where the points are in line
    U, _, Vt = np.linalg.svd(b.T @ a / math.prod(lengths) + told)
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt)) or 1]) @ Vt
    scale = float((b * (a @ R.T)).sum()) / lengths[0] ** 2
    return (scale, R, aim - scale * R @ middle) if scale > 0 else None


def robust(
    count: int, least: int, fit: Callable[[Rows], Fit | None], off: Callable[[Fit], Array]
) -> tuple[Fit, NDArray[np.bool_]] | None:
    """A fit to those of `count` things that agree, and which they are [N]; None: nothing can be fitted.

    It starts from the fit to `least` of them, of all choices or a seeded part of these, that most are least
    off (least median of squares, Rousseeuw 1984); then those within OUTLIER robust standard deviations count,
    until they stay the same.
    """
    tried = 100  # choices of two or three: enough where half of all are wrong
    if math.comb(count, least) <= tried:
        choices = [np.array(rows) for rows in combinations(range(count), least)]
    else:
        rng = np.random.default_rng(0)
        choices = [rng.choice(count, least, replace=False) for _ in range(tried)]
    found = [one for rows in choices if (one := fit(rows)) is not None]
    if not found:
        return None
    best = min(found, key=lambda one: float(np.median(off(one))))
    inliers = np.zeros(count, bool)
    for _ in range(20):  # it settles sooner
        rest = off(best)
        now = rest <= max(OUTLIER * 1.4826 * float(np.median(rest)), ROUNDING)
        better = fit(now)
        if better is None or (now == inliers).all():
            break
        best, inliers = better, now
    return best, inliers
