"""How many iterations a run has: as many as pay, or as fit into its seconds."""

from __future__ import annotations

from collections.abc import Callable

from hqgs.training.constants import DENSE, FEWEST_ITERATIONS, MOST_ITERATIONS, SLOWER, SLOWER_DENSE
from hqgs.training.plan import StepSeconds


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
