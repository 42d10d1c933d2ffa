"""How long a run is, decided while it trains: as long as held-back photos gain, or as its seconds allow.

A few training photos are held back at first, where it is not known how long a run pays: they tell whether it
still improves. Then they come back, early enough that the scene can still grow where only they look. Test
views are never looked at. The rest of a run that has so many seconds, after growth, is as long as the clock
allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from statistics import median

from hqgs.training.plan import PlanRow
from hqgs.training.schedule import CHECKS, COARSE_FACTOR, REST, Decisions, Schedule
from hqgs.training.state import TrainState

# dB and iterations: the run has stopped improving where held-back photos gain no more in so many.
BETTER, PATIENCE = 0.05, 2_000


def by_held_photos(schedule: Schedule, state: TrainState, psnr: Callable[[], float]) -> Decisions:
    """The decisions after a step: whether held-back photos end the run sooner, or come back.

    `psnr`: of those photos now, dB; NaN where their masks leave nothing. Rows of the state tell it.
    """
    decisions, iteration, total = state.decisions, state.iteration, schedule.config.iterations
    if iteration % CHECKS == 0 and not schedule.is_coarse(iteration) and not math.isnan(now := psnr()):
        if now > state.best + BETTER:
            state.best, state.best_at = now, iteration
        if iteration - state.best_at >= PATIENCE:
            length = min(total, math.ceil((1 + REST) * iteration))
            decisions = replace(decisions, length=length, released=iteration)
            why = "the validation photos stopped improving"
            told = f"best {state.best:.2f} dB at iteration {state.best_at}, {now:.2f} dB at {iteration}"
            left = f"iterations {length + 1} to {total}"
            row = PlanRow("length", f"{length:,} iterations", why, told, "iterations", iteration, left)
            state.rows.append(row)
    if iteration == schedule.config.due.stop:
        decisions = replace(decisions, released=iteration)
    if decisions.released:
        why = "the scene needs them where no other photo looks"
        state.rows.append(
            PlanRow("validation photos", "trained on from here", why, "", "held_photos", iteration)
        )
    return decisions


def by_the_clock(
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


def seconds_left(schedule: Schedule, state: TrainState, pixels: float) -> float:
    """What the steps to come will take, by the last ones: a step takes time for its pixels and its Gaussians,
    about as much for one as for the other. `pixels`: of a training photo, in the mean.
    """
    done, length, count = state.iteration, state.decisions.length, len(state.gaussians)
    small = pixels / COARSE_FACTOR**2
    coarse = max(min(schedule.run.half_size_until, length) - done, 0)
    stop, growth = schedule.densification_end(state.decisions), schedule.config.densify
    growing = max(stop - done, 0) if schedule.config.due.start < stop else 0
    # Until growth ends a scene gains about twice its Gaussians: 1.4 to 7.5 times in runs of 1,000.
    more = min(2 * (growing / max(stop, 1)) ** 2 * count, max(growth.max_gaussians - count, 0))
    work = coarse * small + (length - done - coarse) * pixels
    work += count * (length - done) + more * (length - done - growing / 2)
    return median(state.recent) * work / ((small if coarse else pixels) + count) if state.recent else 0.0
