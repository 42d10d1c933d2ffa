"""What the writers share: rows that can be written, and an order that puts neighbours side by side."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from hqgs.model.formats.arrays import TENSORS, Arrays

CURVE_BITS = 10  # of a cell along each axis
SHARE_STEP = 2.0**-24  # between float32 shares near 1


def finite_rows(arrays: Arrays) -> NDArray[np.bool_]:
    """Which Gaussians hold no NaN or Inf, and a rotation that is one, [N]."""
    return whole_rows(arrays) & (np.square(arrays["quats"].astype(np.float64)).sum(axis=1) > 0)


def whole_rows(arrays: Arrays) -> NDArray[np.bool_]:
    """Which Gaussians hold no NaN or Inf, [N]."""
    keep = np.ones(len(arrays["means"]), np.bool_)
    for name in TENSORS:
        values = arrays[name]
        keep &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    return keep


def pick(arrays: Arrays, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Arrays:
    """Those rows of each array."""
    names = (*TENSORS, "errors") if "errors" in arrays else TENSORS
    return cast(Arrays, {name: arrays[name][rows] for name in names})


def sound_errors(values: NDArray[Any]) -> NDArray[np.float32]:
    """Errors of Gaussians from a file: what is no number, or out of range, is not to be trusted at all."""
    with np.errstate(invalid="ignore"):
        return np.where((values >= 0) & (values <= 1), values, 1).astype(np.float32)


def curve_order(means: NDArray[np.floating]) -> NDArray[np.intp]:
    """The order of points [N, 3] along a Morton curve."""
    if not len(means):
        return np.zeros(0, np.intp)
    points = np.nan_to_num(means.astype(np.float64))
    low, high = np.quantile(points, [0.01, 0.99], axis=0)  # a few far ones must not make the cells large
    cells = (points - low) / np.where(high > low, high - low, 1) * (2**CURVE_BITS - 1)
    cells = cells.clip(0, 2**CURVE_BITS - 1).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def to_logits(opacities: NDArray[np.floating], step: float) -> NDArray[np.float32]:
    """Logits of opacities 0..1; 0 and 1 have none and are taken a quarter of a step inwards."""
    inside = opacities.astype(np.float64).clip(0.25 * step, 1 - 0.25 * step)
    return np.log(inside / (1 - inside)).astype(np.float32)


def to_opacities(logits: NDArray[np.floating]) -> NDArray[np.float64]:
    """The sigmoid."""
    return 1 / (1 + np.exp(-logits.astype(np.float64).clip(-700, 700)))


def smallest_three(quats: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Of quaternions [N, 4] of any norm the place of the largest component [N], and the others [N, 3] where
    that one is positive and the norm 1: no larger than sqrt(1/2)."""
    quats = np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True), np.float64)
    place = np.abs(quats).argmax(axis=1)
    largest = np.arange(4) == place[:, None]
    return place, (quats * np.where(quats[largest] < 0, -1, 1)[:, None])[~largest].reshape(-1, 3)


def of_smallest_three(place: NDArray[np.integer], three: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quaternions [N, 4] of `smallest_three`."""
    quats, largest = np.empty((len(three), 4)), np.arange(4) == place[:, None]
    quats[~largest] = three.ravel()
    quats[largest] = np.sqrt(np.maximum(0, 1 - np.square(three).sum(axis=1)))
    return quats
