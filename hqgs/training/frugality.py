"""What a run leaves out by itself, decided while it trains, from training photos that are held back.

A few training photos are held back at first, where it is not known how long a run pays: they tell whether it
still improves. Then they come back, early enough that the scene can still grow where only they look. Test
views are never looked at.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from hqgs.base.left_out import LeftOut
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import View
from hqgs.training.plan import PlanRow
from hqgs.training.schedule import CHECKS, FINEST, REST, Decisions, Schedule
from hqgs.training.state import TrainState

# dB and iterations: the run has stopped improving where held-back photos gain no more in so many.
BETTER, PATIENCE = 0.05, 2_000


@dataclass
class Memory:
    """What the decisions go by and what they came to. A checkpoint holds it."""

    refused: int = 0  # growth of Gaussians that are too fine
    best: float = -1e3  # dB, on the held-back photos
    best_at: int = 0
    seconds: float = 0.0  # that the trials took
    records: list[dict[str, Any]] = field(default_factory=list)  # of `LeftOut`, each with its `item`


class Frugality:
    """The judge of one run. It changes nothing itself; with nothing to leave out no bit depends on it."""

    def __init__(
        self,
        schedule: Schedule,
        views: Sequence[View],
        shown: Callable[[], Gaussians],
        psnr: Callable[[Gaussians, Sequence[int]], float],
    ) -> None:
        """
        Args:
            views: those for training.
            shown: gives the Gaussians that are rasterized now, without a gradient history.
            psnr: of Gaussians to rasterize on training photos of these numbers, as the method compares them.
        """
        self.schedule: Schedule = schedule
        self.views: Sequence[View] = views
        self.memory: Memory = Memory()
        self._shown, self._psnr = shown, psnr
        self._seconds: deque[float] = deque(maxlen=50)  # of the last steps

    def after_step(self, state: TrainState, refused: int, seconds: float) -> Decisions:
        """Note what the step did, and decide what is due at this iteration.

        `refused`: Gaussians that were too fine to grow. `seconds`: of the step.
        """
        self._seconds.append(seconds)
        self.memory.refused += refused
        if not self.schedule.holds(state.decisions):
            return state.decisions
        started = time.perf_counter()
        decisions = self._of_held_photos(state)
        self.memory.seconds += time.perf_counter() - started
        return decisions

    @property
    def step_seconds(self) -> float:
        """Of a step now, the mean of the last ones; 0 before the first."""
        return sum(self._seconds) / len(self._seconds) if self._seconds else 0.0

    def left_out(self) -> list[LeftOut]:
        """What was left out, in the order of the decisions."""
        records = self.memory.records
        found = [LeftOut(**{k: v for k, v in record.items() if k != "item"}) for record in records]
        if self.memory.refused:
            why = f"they were no wider than {FINEST:g} pixels of the sharpest photo, so no photo shows more"
            found.insert(0, LeftOut(f"{self.memory.refused} splits of small Gaussians", why))
        return found

    def state_dict(self) -> dict[str, Any]:
        """As JSON values; of a run whose length the clock will tell, the seconds of its last steps too."""
        timed = {"steps": list(self._seconds)} if self.schedule.run.clock_most else {}
        return asdict(self.memory) | timed

    def load_state_dict(self, state: dict[str, Any]) -> None:
        memory = dict(state)
        self._seconds = deque(memory.pop("steps", ()), self._seconds.maxlen)
        self.memory = Memory(**memory)

    def forget_end(self) -> None:
        """The run goes on after its end: no iterations are left out."""
        self.memory.records = [one for one in self.memory.records if one["item"] != "iterations"]

    def _of_held_photos(self, state: TrainState) -> Decisions:
        """What the held-back photos say, and whether they come back."""
        schedule, iteration, decisions = self.schedule, state.iteration, state.decisions
        tries = iteration % CHECKS == 0 and not schedule.is_coarse(iteration)
        if tries and (length := self._length(state, self._shown())) is not None:
            decisions = replace(decisions, length=length, released=iteration)
        if iteration == schedule.config.densify.stop:
            decisions = replace(decisions, released=iteration)
        if decisions.released:
            why = "early enough that the scene can grow where only they look"
            row = PlanRow("photos held back", "back", why, "", "held_photos", iteration)
            state.rows.append(row)
        return decisions

    def _length(self, state: TrainState, shown: Gaussians) -> int | None:
        """Of the run, where the held-back photos have stopped improving; None: they have not."""
        memory, iteration, total = self.memory, state.iteration, self.schedule.config.iterations
        now = self._psnr(shown, self.schedule.held)
        if math.isnan(now):  # their masks leave nothing: they tell nothing
            return None
        if now > memory.best + BETTER:
            memory.best, memory.best_at = now, iteration
        if iteration - memory.best_at < PATIENCE:
            return None
        length = min(total, math.ceil((1 + REST) * iteration))
        left = LeftOut(
            f"iterations {length + 1} to {total}",
            "the held-back photos stopped improving",
            f"best {memory.best:.2f} dB at iteration {memory.best_at}, {now:.2f} dB at {iteration}",
        )
        self._note("iterations", "length", f"{length:,} iterations", left, state)
        return length

    def _note(self, item: str, what: str, value: str, left: LeftOut, state: TrainState) -> None:
        """Keep what is left out by this item, and the row that tells it."""
        self.memory.records.append(asdict(left) | {"item": item})
        row = PlanRow(what, value, left.why, left.evidence or "", item, state.iteration)
        state.rows.append(row)
