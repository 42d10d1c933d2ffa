"""How long the runs of a study will take."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measure import Training
from hqgs.scene.scene import Scene

if TYPE_CHECKING:
    from benchmarks.study import Cell

# A whole run's seconds per step over those of its first steps, if there is room for more Gaussians: the
# built-in scene at 504 px takes 22 ms in its first 400 steps and 55 ms on average over 2,000.
GROWTH = 2.5
WARM, FIRST = 3, 10  # steps before the first ones that count, and how many of those


class Estimate:
    """Seconds per step by scene and row: from finished runs, else from a few steps and their growth."""

    def __init__(self) -> None:
        self._finished: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
        self._first: dict[tuple[str, str], float] = {}

    def add(self, cell: Cell, run: dict[str, Any]) -> None:
        """Learn from a finished run."""
        self._finished[cell.kind].append(run["wall_seconds"] / max(run["iterations"], 1))

    def probe(self, cell: Cell, photos: Callable[[Cell], Scene]) -> None:
        """Train a few steps of a cell, on its photos, if nothing is known of it."""
        if cell.kind not in self._finished and cell.kind not in self._first:
            done = Training(photos(cell), cell.config)
            done.steps(WARM)
            before = done.trainer.seconds
            done.steps(FIRST)
            room = done.trainer.config.densify.max_gaussians / max(done.initial_points, 1)
            self._first[cell.kind] = min(GROWTH, room) * (done.trainer.seconds - before) / FIRST

    def seconds(self, cells: Iterable[Cell]) -> float:
        """What these cells will take together, as far as they are known."""
        known = self._first | {kind: float(np.mean(done)) for kind, done in self._finished.items()}
        return sum(cell.config.iterations * known.get(cell.kind, 0.0) for cell in cells)


def duration(seconds: float) -> str:
    """`45 s`, `12 min` or `3 h 05 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
