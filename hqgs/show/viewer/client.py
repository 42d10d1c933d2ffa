"""A page that is open: what it waits for."""

from __future__ import annotations

import time
from typing import Any

from hqgs.show.constants import COARSEST, GOAL, REST, SHARP


class Client:
    """A page: what it waits for."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self.stale: bool = True  # what it shows is not what it should
        self.coarse: int = SHARP // 2  # px, of a picture while it moves
        self._last_move = 0.0
        self._is_sharp = False

    def moved(self) -> None:
        """Its camera has another pose."""
        self._last_move = time.monotonic()
        self.stale = True

    def waits(self) -> bool:
        """Whether it needs a picture: another one, or the same sharper."""
        return self.stale or (not self._is_sharp and self._rests())

    def begin(self) -> bool:
        """A picture for it is begun: whether a sharp one."""
        self.stale, self._is_sharp = False, self._rests()
        return self._is_sharp

    def took(self, seconds: float, height: int, sharp: bool) -> None:
        """Choose the height of the next coarse picture by the time of this one."""
        if not sharp:
            wanted = height * (GOAL / max(seconds, 1e-3)) ** 0.5
            self.coarse = int(min(max(0.5 * (self.coarse + wanted), COARSEST), SHARP))

    def _rests(self) -> bool:
        return time.monotonic() - self._last_move > REST
