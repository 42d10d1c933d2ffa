"""How many iterations a run has: as many as pay, or as fit into its seconds."""

from __future__ import annotations

from collections.abc import Callable

from hqgs.training.plan import StepSeconds

# A mean step of a run over one at its start. One that starts from points all over the photos grows little,
# and its Gaussians hide more of each other as they become opaque.
GROWTH, GROWTH_DENSE = 2.0, 1.0
DENSE = 2  # times the scene's own points
FEWEST, MOST = 50, 30_000  # iterations of a run that has a number of seconds


def fitting(
    seconds: float, step: StepSeconds, first: float, half_until: Callable[[int], int], most: int | None = None
) -> int:
    """As many iterations as fit into `seconds`; `most` of them at most.

    Args:
        step: seconds of a step at the start of the run.
        first: its Gaussians at the start, in times of the scene's points.
        half_until: the last iteration at half size of a run of so many.
    """
    growth = GROWTH_DENSE if first > DENSE else GROWTH

    def needed(iterations: int) -> float:
        half = half_until(iterations)
        return growth * (half * step.half + (iterations - half) * step.full)

    few, many = FEWEST, MOST if most is None else max(most, FEWEST) + 1
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (middle, many) if needed(middle) <= seconds else (few, middle)
    return few
