"""The length of a run that has so many seconds, by the clock; pace.py tells it before the run."""

from __future__ import annotations

from dataclasses import replace

from hqgs.training.schedule import Decisions, Schedule


def turned(
    schedule: Schedule, decisions: Decisions, iteration: int, seconds: float, step: float
) -> Decisions:
    """The decisions after a step: at `Schedule.turn_at` the rest gets the length that the clock allows.

    `seconds`: that the run has taken; `step`: those of a step now. Settings with a `turn` follow that in
    place of the clock.
    """
    config = schedule.config
    if decisions.turned:
        return decisions
    at, most = schedule.turn_at(decisions), schedule.run.clock_most
    if config.turn is not None:
        length = config.turn[1]
    elif most and config.seconds is not None:
        rest = config.iterations - at
        left = (config.seconds - seconds) / step if step > 0 else rest
        length = at + round(min(max(left, 0.1 * rest), 4.0 * rest))
        length = min(length, most)
    else:
        return decisions
    if iteration != at or not at < min(length, config.iterations) or length == decisions.length == most:
        return decisions
    return replace(decisions, length=length, turned=at)
