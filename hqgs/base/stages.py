"""What takes long before the first step of a run, told while it happens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """Where some work has come to."""

    what: str  # "features", "matches", ...: the same words as long as it is the same work
    done: int
    total: int  # 0: not known
    note: str = ""  # a sentence that the user should read before the work begins


OnStage = Callable[[Stage], None]


def silent(stage: Stage) -> None:
    """Nobody listens."""
