"""What a run is, decided once before its first step: the facts that it goes by, and the plan of them.

rules.py makes the plan. It is all that a run reads, and nothing changes it. What is decided later, by the
clock or by photos that are held back, is added to the run's rows with the iteration after which it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from hqgs.base.left_out import CORRECTION, LeftOut
from hqgs.base.text import aligned
from hqgs.evaluation.constants import SCATTER
from hqgs.evaluation.records import PlanRowRecord
from hqgs.training.config import TrainConfig


@dataclass(frozen=True)
class StepSeconds:
    """Of one view of a step at the start of a run, on this machine."""

    full: float
    half: float  # at half the sides; 0: there are no such steps


@dataclass(frozen=True)
class Tried:
    """What a run gains by a part, or without it, in short runs on small copies (`hqgs.training.trial`)."""

    gain: float  # dB, mean over photos held back
    error: float  # standard error of that mean
    photos: int  # that were held back
    sure: float  # mean gain over its standard error, the mean over the measures that it goes by

    @property
    def pays(self) -> bool:
        """Whether the gain is more than photos scatter."""
        return self.gain > SCATTER and self.sure > 1

    def __str__(self) -> str:
        return f"{self.gain:+.2f} ± {self.error:.2f} dB on {self.photos} validation photos of short test runs"


@dataclass(frozen=True)
class Facts:
    """What a run's decisions go by, beside the diagnosis of its photos."""

    photos: int  # for training
    pixels: int  # of their cameras, in all
    shortest_side: int  # px, of all photos
    points: int  # of the reconstruction
    linked: bool  # whether it tells which photos see which of its points (`Scene.seen`)
    agreed: float | None = None  # share of depths along edges on which photos agree; None: not looked at
    unused: tuple[LeftOut, ...] = ()  # photos that teach nothing
    tried: Tried | None = None  # what is gained without growth; None: not tried
    looks: Mapping[str, Tried] = field(default_factory=dict)  # what is gained by parts of the formation
    found: bool = False  # whether its cameras were found from the photos alone
    # What the method tells of the photos (`Method.facts`):
    as_photographed: bool = False  # renders are compared with photos as they are, of any size
    sizes: tuple[tuple[int, int], ...] = ()  # height and width of each photo as it was taken
    kept: int | None = None  # luma coefficients that the photos' codec did not round to zero; None: no JPEG
    noisy: int = 0  # photos that have noise of their own
    undirected: tuple[str, ...] = ()  # names of photos blurred by a motion of unknown direction
    # Of the machine:
    seconds: StepSeconds | None = None  # None: no step was timed


@dataclass(frozen=True)
class PlanRow:
    """One decision."""

    what: str
    value: str
    why: str  # one sentence
    evidence: str = ""  # what was measured
    rule: str = ""  # the rule's name and its source
    iteration: int = 0  # after which it was decided; 0: before the first step
    left_out: str | None = None  # what the run does without by it; None: nothing

    def known(self) -> PlanRowRecord:
        """As the report has it."""
        more = {"evidence": self.evidence, "rule": self.rule, "iteration": self.iteration}
        known = {name: value for name, value in more.items() if value}
        return {"what": self.what, "value": self.value, "why": self.why, **known}


@dataclass(frozen=True)
class RunPlan:
    """Everything that a run reads of what was decided before its first step."""

    settings: TrainConfig  # the one asked for, with what the rules decided
    first_points: int  # Gaussians to start from, as far as photos agree on so many; at least its points
    found_back: bool = False  # they are what photos find back in each other; else what agrees along edges
    discs: bool = False  # the first ones are flat, as their neighbours lie; else round
    held_photos: int = 0  # training photos that are held back at first
    half_size_until: int = 0  # the last iteration at half the photos' sides; 0: there is none
    clock_most: int = 0  # iterations that the clock may give the run after growth; 0: it does not look at it
    rows: tuple[PlanRow, ...] = field(default=(), repr=False)

    def __str__(self) -> str:
        return plan_table(self.rows)


def left_out_of(rows: Sequence[PlanRow]) -> list[LeftOut]:
    """What a run does without by these rows."""
    return [LeftOut(row.left_out, row.why, row.evidence or None) for row in rows if row.left_out is not None]


def essential(plan: RunPlan) -> str:
    """The rows that a user should know of before the run, as lines."""
    always = ("method", "formation", "loss", "budget", "first points", "length")
    where_used = ("opacity decay", "dropout of Gaussians")
    used = [row.what for row in plan.rows if row.what in where_used and row.value != "none"]
    return plan_table([row for row in plan.rows if row.what in (*always, *used)])


def plan_table(rows: Sequence[PlanRow]) -> str:
    """The rows as lines that a person reads; the corrections that are not needed share the last one."""
    none = [row.what.removeprefix(CORRECTION) for row in rows if row.what.startswith(CORRECTION)]
    lines = [(row.what, row.value, _reason(row)) for row in rows if not row.what.startswith(CORRECTION)]
    last = [("other corrections", "none", f"not needed for {', '.join(none)}")] if none else []
    return aligned(lines + last)


def _reason(row: PlanRow) -> str:
    when = f"after iteration {row.iteration}: " if row.iteration else ""
    return f"{when}{row.why}" + (f" ({row.evidence})" if row.evidence else "")
