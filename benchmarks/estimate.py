"""How long the runs of a study will take."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measure import FIRST_STEPS, first_step, train
from hqgs.scene.scene import Scene

if TYPE_CHECKING:
    from collections.abc import Iterable

    from benchmarks.study import Cell

# A whole run's seconds per step over those of its first steps, until runs are finished that tell: the
# built-in scene at 504 px takes 22 ms in its first 400 steps and 55 ms on average over 2,000. Runs that start
# with nearly all the Gaussians that they may have do not get slower.
GROWTH = 2.5

Kind = tuple[str, str]  # scene, row: what a cell's speed depends on most


class Estimate:
    """Seconds per step by scene and row: from finished runs, else from a few steps and their growth."""

    def __init__(self) -> None:
        self._finished: defaultdict[Kind, list[float]] = defaultdict(list)
        self._first: dict[Kind, tuple[float, float]] = {}  # and how many times the Gaussians may grow
        self._growth: list[float] = []  # of the runs that had room for it

    def add(self, cell: Cell, run: dict[str, Any]) -> None:
        """Learn from a finished run."""
        per_step = run["wall_seconds"] / max(run["iterations"], 1)
        self._finished[_kind(cell)].append(per_step)
        if run["config"]["densify"]["max_gaussians"] > GROWTH * max(run["initial_points"], 1):
            self._growth.append(per_step / run["first_step_seconds"])

    def knows(self, cell: Cell) -> bool:
        return _kind(cell) in self._finished or _kind(cell) in self._first

    def probe(self, cell: Cell, photos: Scene) -> None:
        """Train a few steps of a cell."""
        done = train(photos, cell.config, evaluate=False, at_most=FIRST_STEPS.stop)
        most = done.trainer.config.densify.max_gaussians
        self._first[_kind(cell)] = first_step(done.steps), most / max(done.initial_points, 1)

    def seconds(self, cells: Iterable[Cell]) -> float:
        """What these cells will take together, as far as they are known."""
        growth = float(np.median(self._growth)) if self._growth else GROWTH
        total = 0.0
        for cell in cells:
            if done := self._finished.get(_kind(cell)):
                per_step = float(np.mean(done))
            else:
                first, room = self._first.get(_kind(cell), (0.0, 1.0))
                per_step = first * min(growth, room)
            total += cell.config.iterations * per_step
        return total


def duration(seconds: float) -> str:
    """`45 s`, `12 min` or `3 h 05 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _kind(cell: Cell) -> Kind:
    return cell.scene.name, cell.row.label
