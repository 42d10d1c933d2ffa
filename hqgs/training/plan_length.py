"""How many iterations a run has, as many as pay, or as fit into its seconds; and what of its end is shown."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hqgs.training.constants import (
    DENSE,
    FEWEST_ITERATIONS,
    MOST_ITERATIONS,
    SHOWN_PART,
    SLOWER,
    SLOWER_DENSE,
)
from hqgs.training.plan import Choice, Draft, StepSeconds


def fitting(
    seconds: float, step: StepSeconds, first: float, half_until: Callable[[int], int], most: int | None = None
) -> int:
    """As many iterations as fit into `seconds`; `most` of them at most.

    Args:
        step: seconds of a step at the start of the run.
        first: its Gaussians at the start, in times of the scene's points.
        half_until: the last iteration at half size of a run of so many.
    """
    growth = SLOWER_DENSE if first > DENSE else SLOWER

    def needed(iterations: int) -> float:
        half = half_until(iterations)
        return growth * (half * step.half + (iterations - half) * step.full)

    few, many = FEWEST_ITERATIONS, MOST_ITERATIONS if most is None else max(most, FEWEST_ITERATIONS) + 1
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (middle, many) if needed(middle) <= seconds else (few, middle)
    return few


def shown(draft: Draft) -> Sequence[Choice]:
    asked = draft.asked.averaged
    if asked is not None or not draft.formed:
        return (
            [] if asked is None else [Choice(f"the mean over the last {asked:.0%} of the steps", "asked for")]
        )
    why = "each step serves one photo, and their mean serves all"
    value = f"the mean over the last {SHOWN_PART:.0%} of the steps"
    return [Choice(value, why, changes={"averaged": SHOWN_PART})]
