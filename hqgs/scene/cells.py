"""Cells that tile space: a scene cut by planes, each part the convex cell of one of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Cut:
    """A plane, and what lies on its two sides: another cut, or the number of a part, from 0."""

    normal: tuple[float, float, float]  # unit, world
    offset: float  # world units; a point x lies above where normal . x >= offset
    below: Cells
    above: Cells


Cells: TypeAlias = "Cut | int"


def height(cut: Cut, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """normal . x - offset of points [P, 3]; [P]."""
    # Written out, in float64: the same bits wherever it is asked, or a point might be in two parts.
    x, y, z = points.astype(np.float64).T
    return x * cut.normal[0] + y * cut.normal[1] + z * cut.normal[2] - cut.offset


def count(cells: Cells) -> int:
    """How many cells there are."""
    return 1 if isinstance(cells, int) else count(cells.below) + count(cells.above)


def cell_of(cells: Cells, points: NDArray[np.floating]) -> NDArray[np.uint16]:
    """The part that each point [P, 3] lies in, [P]. Each lies in exactly one."""
    found = np.zeros(len(points), np.uint16)

    def mark(cells: Cells, rows: NDArray[np.intp]) -> None:
        if isinstance(cells, int):
            found[rows] = cells
            return
        above = height(cells, points[rows]) >= 0
        mark(cells.below, rows[~above])
        mark(cells.above, rows[above])

    mark(cells, np.arange(len(points)))
    return found


def sight_shares(cells: Cells, center: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much of what a camera at `center` [3] sees at `ends` [M, 3] is each part's, [parts], 0..1.

    The mean over the lines of sight: 1 for the cell in which a line ends, for the others the share of its
    length that lies in them. So a photo counts for what it shows, and for the air in which nothing may hang.
    """
    shares = np.zeros(count(cells))

    def walk(
        cells: Cells,
        first: NDArray[np.float64],
        last: NDArray[np.float64],
        inside: NDArray[np.bool_],
    ) -> None:
        """`first`, `last`: the stretch of each line in this cell, 0 at the camera; `inside`: it ends here."""
        if isinstance(cells, int):
            shares[cells] = np.where(inside, 1.0, np.maximum(last - first, 0.0)).mean()
            return
        start, end = float(height(cells, center[None])[0]), height(cells, ends)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = np.where((start >= 0) == (end >= 0), 1.0, start / (start - end))
        near, far = (first, np.minimum(last, crossing)), (np.maximum(first, crossing), last)
        low, high = (far, near) if start >= 0 else (near, far)
        walk(cells.below, *low, inside & (end < 0))
        walk(cells.above, *high, inside & (end >= 0))

    if len(ends):
        walk(cells, np.zeros(len(ends)), np.ones(len(ends)), np.ones(len(ends), np.bool_))
    else:
        shares[cell_of(cells, center[None])[0]] = 1.0
    return shares


def cut_space(places: NDArray[np.float64], points: NDArray[np.floating], parts: int) -> Cells:
    """So many cells, balanced in photos and points alike.

    Space is halved again and again (by thirds where the number asks for it), each time across the direction
    in which the photos' places vary most.

    Args:
        places: [N, 3], the middle of what each photo shows.
        points: [M, 3] of the scene.
        parts: at least 1.

    Raises ValueError where there is nothing left to cut.
    """
    return _cut(places, points.astype(np.float64), 0, parts)


def _cut(places: NDArray[np.float64], points: NDArray[np.float64], first: int, parts: int) -> Cells:
    if parts == 1:
        return first
    low = parts // 2
    normal = _longest(places if len(places) > 1 and np.ptp(places, axis=0).any() else points)
    plane = Cut(normal, 0.0, 0, 0)
    heights = [height(plane, rows) for rows in (places, points)]
    plane = Cut(normal, _quantile(heights, low / parts), 0, 0)
    sides = [(rows, height(plane, rows) >= 0) for rows in (places, points)]
    below, above = ([rows[side == up] for rows, side in sides] for up in (False, True))
    return Cut(
        plane.normal,
        plane.offset,
        _cut(below[0], below[1], first, low),
        _cut(above[0], above[1], first + low, parts - low),
    )


def _longest(rows: NDArray[np.float64]) -> tuple[float, float, float]:
    """The direction in which points [P, 3] vary most, with its largest component positive."""
    if len(rows) < 2:
        raise ValueError("there are too few photos and points for so many parts")
    centred = rows - rows.mean(0)
    spread = np.array([[(centred[:, i] * centred[:, j]).mean() for j in range(3)] for i in range(3)])
    axis = np.linalg.eigh(spread)[1][:, 2]
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    return float(axis[0]), float(axis[1]), float(axis[2])


def _quantile(heights: list[NDArray[np.float64]], share: float) -> float:
    """A height between two of them, with that share of the weight below it; each list weighs the same."""
    kept = [rows for rows in heights if len(rows)]
    values = np.concatenate(kept)
    weights = np.concatenate([np.full(len(rows), 1 / len(rows) / len(kept)) for rows in kept])
    order = np.argsort(values, kind="stable")
    values, below = values[order], np.cumsum(weights[order])
    gaps = np.flatnonzero(values[1:] > values[:-1])  # the plane runs through none of them
    if not len(gaps):
        raise ValueError("photos and points lie in one place, which no plane can cut")
    at = gaps[np.abs(below[gaps] - share).argmin()]
    return float((values[at] + values[at + 1]) / 2)
