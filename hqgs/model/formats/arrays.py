"""What the formats read and write: the arrays, which rows can be written, packed rotations, an order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from hqgs.model.constants import SH_C0
from hqgs.scene.world import World

SHARE_STEP = 2.0**-24  # between float32 shares near 1
Floats = NDArray[np.float32] | NDArray[np.float64]


class Told(TypedDict, total=False):
    """What a file says beside its numbers."""

    world: World  # the frame of the file, where that is another
    moved: NDArray[np.float64]  # [4, 4]: on reading, from the frame of what lies beside the file to `world`'s
    antialiased: bool  # it was trained with, and is to be seen with, the compensation of "antialiased"
    notes: list[str]  # what was left out or changed on reading
    errors: NDArray[np.float32]  # [N], of the pixels that each shows, white is 1


class Arrays(Told):
    """N Gaussians as `hqgs.Gaussians` has them, before their activations."""

    means: Floats  # [N, 3], world units
    scales: Floats  # [N, 3], logs
    quats: Floats  # [N, 4], w x y z
    opacities: Floats  # [N], logits
    sh0: Floats  # [N, 1, 3]
    shN: Floats


TENSORS = tuple(name for name in Arrays.__annotations__ if name in Arrays.__required_keys__)


@dataclass(frozen=True)
class Format:
    """A row of the table of formats: how a file is told, read and written, and what it has a place for."""

    read: Callable[[Path], Arrays]
    write: Callable[[Path, Arrays], int] | None = None  # returns the rows left out; None: it is only read
    starts: tuple[bytes, ...] = ()  # how such a file begins; (): its bytes tell nothing
    of: str | None = None  # the format whose content it has, where that is another's
    world: bool = False  # the frame of the scene
    errors: bool = False  # what trust was learned
    antialiased: bool = False  # that flag
    harmonics: bool = True


def writable(arrays: Arrays, what: str = "", *, curve: bool = False) -> tuple[Arrays, int]:
    """The Gaussians without NaN or Inf and with a rotation, and how many others there were.

    `curve`: in an order that puts neighbours side by side. ValueError where none is left, and `what` is a
    format that has one at least.
    """
    keep = np.flatnonzero(
        whole_rows(arrays) & (np.square(arrays["quats"].astype(np.float64)).sum(axis=1) > 0)
    )
    if what and not len(keep):
        raise ValueError(f"no Gaussian to write; a {what} file needs at least one")
    rows = keep[curve_order(arrays["means"][keep])] if curve else keep
    return pick(arrays, rows), len(arrays["means"]) - len(keep)


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
    bits = 10  # of a cell along each axis
    low, high = np.quantile(points, [0.01, 0.99], axis=0)  # a few far ones must not make the cells large
    cells = (points - low) / np.where(high > low, high - low, 1) * (2**bits - 1)
    cells = cells.clip(0, 2**bits - 1).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def shown(sh0: Floats) -> NDArray[np.float64]:
    """The colours [N, 3], white is 1, of harmonics of degree 0 [N, 1, 3]."""
    return 0.5 + SH_C0 * sh0[:, 0].astype(np.float64)


def of_colors(colors: NDArray[Any]) -> NDArray[np.float64]:
    """The harmonics [N, 1, 3] of `shown`."""
    return ((colors.astype(np.float64) - 0.5) / SH_C0)[:, None]


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
