"""What happened to photos as a formula: `blur:2.5+jpeg:10`, parsed and printed."""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Kind:
    """The values that one kind of step takes, and where it may stand."""

    lowest: float
    highest: float
    unit: str
    takes: str = ""  # what its value is, in a word
    integer: bool = False
    at_504: float | None = None  # the value where none is written, in px of a photo 504 px wide
    default: float | None = None  # the same, for a value that does not depend on the photo's size
    formation: bool = True  # whether a method can be told of it
    some: bool = True  # whether it may happen to some of the photos only
    longest: bool = False  # whether its value is of the photo's longest side, not of its width
    own: str | None = None  # of each "photo" or "camera" its own, learned with the scene; or "found" before


KINDS = {
    "jpeg": Kind(1, 95, "a quality", "QUALITY", integer=True),
    "noise": Kind(0.01, 255, "a standard deviation, where white is 255", "SIGMA"),
    "lowres": Kind(2, 16, "a factor", "FACTOR", integer=True, some=False),
    "blur": Kind(0.1, 50, "sigma in px", "SIGMA", at_504=2.5),
    "defocus": Kind(0.5, 50, "a radius in px", "RADIUS", at_504=5.0),
    "motion": Kind(1, 200, "a length in px", "LENGTH", at_504=15.0),
    "shake": Kind(0.5, 200, "the longest extent of a shake in px", "PX", at_504=12.0, own="photo"),
    "focus": Kind(0, math.inf, "no value", default=0, some=False, own="photo"),
    "exposure": Kind(0.01, 4, "the largest deviation in stops", "EV", default=1, own="photo"),
    "vignetting": Kind(0, math.inf, "no value", default=0, some=False, own="camera"),
    "response": Kind(0, math.inf, "no value", default=0, some=False, own="camera"),
    "grain": Kind(0, math.inf, "no value", default=0, some=False, own="found"),
    "video": Kind(0, 51, "a constant rate factor", "CRF", integer=True, default=36, some=False, own="found"),
}  # the benchmarks have more
NONE, MIXED, SOME = "none", "mixed", "some"
DEVICES = tuple(name for name, kind in KINDS.items() if kind.own == "camera")  # in all photos of a camera
LEARNED = tuple(name for name, kind in KINDS.items() if kind.own in ("photo", "camera"))
OWN = tuple(name for name, kind in KINDS.items() if kind.own)  # of each photo its own
LINEAR = frozenset({"blur", "defocus", "motion", "lowres"})  # they take fine detail of all photos alike
ERRORS = frozenset({"noise", "jpeg"})  # all photos show what is not there
NOT_MADE = {
    "focus": "focus depends on depths, which a photo does not show; defocus:R blurs the whole photo",
    **dict.fromkeys(DEVICES, "it belongs to a camera, and which camera took a photo is unknown"),
    "grain": "grain means that each photo has its own noise; some:noise:SIGMA makes such photos",
    **dict.fromkeys(("shake", "exposure", "video"), "hqgs undoes it; only its benchmarks make such photos"),
}  # what a method can be told of only, and what to write for photos


def film_alone(kinds: Set[str]) -> bool:
    """Whether of a film its codec is told, and at most what a camera does to all photos."""
    return kinds - set(DEVICES) == {"video"}


def undegraded(kinds: Set[str]) -> bool:
    """Whether photos are as photographed, or each with what its own camera did; a film alone is not."""
    return kinds <= set(OWN) and not film_alone(kinds)


def grammar() -> str:
    """The steps that photos can be degraded by, as they are written."""
    made = [(name, kind) for name, kind in KINDS.items() if name not in NOT_MADE]
    return ", ".join(
        f"{name}:{kind.takes}" if kind.at_504 is None and kind.default is None else f"{name}[:{kind.takes}]"
        for name, kind in made
    )


@dataclass(frozen=True)
class DegradationStep:
    """One step. ValueError for an unknown kind, or a value outside the kind's range."""

    kind: str
    value: float | None = None  # None: the default, which may scale with the photo's size
    some: bool = False  # whether it happens to half of the photos only, at mixed strengths

    def __post_init__(self) -> None:
        if self.some and not (self.kind in KINDS and KINDS[self.kind].some):
            wanted = ", ".join(name for name, kind in KINDS.items() if kind.some)
            raise ValueError(f"{SOME} takes one of {wanted}; got {SOME}:{self.kind}")
        if self.kind not in KINDS:
            raise ValueError(
                f"unknown degradation {self.kind!r}; there are: {', '.join([*KINDS, MIXED, NONE])}, "
                f"{SOME}:KIND, and steps joined by +"
            )
        kind = KINDS[self.kind]
        wanted = f"{kind.unit}, {'an integer in ' if kind.integer else ''}{kind.lowest:g}..{kind.highest:g}"
        if self.value is None:
            if kind.at_504 is None and kind.default is None:
                raise ValueError(f"{self.kind} needs a value: {self.kind}:VALUE with {wanted}")
        elif not kind.lowest <= self.value <= kind.highest or (kind.integer and self.value % 1):
            raise ValueError(f"{self.kind} is {self.value:g}, wanted {wanted}")

    def scaled(self, factor: float) -> DegradationStep:
        """The step with `factor` times its value, which it has, within the kind's range; for all photos."""
        if self.value is None:
            raise ValueError(f"{self} has no value that could be scaled")
        return DegradationStep(self.kind, within(KINDS[self.kind], self.value * factor))

    def __str__(self) -> str:
        name = f"{SOME}:{self.kind}" if self.some else self.kind
        if self.value is None:
            return name
        # The shortest text that reads back as the value.
        return f"{name}:{int(self.value) if self.value == int(self.value) else float(self.value)!r}"


@dataclass(frozen=True)
class Degradation:
    """Steps in the order in which they happen; none for a clean photo. `str()` is what the parser reads."""

    steps: tuple[DegradationStep, ...]

    def for_width(self, width: int, height: int | None = None) -> Degradation:
        """The same with a value in every step, for photos `width` px wide and `height` px high.

        A default in px scales with the width of the picture that its step meets, within the kind's range;
        that of `chat` scales with the longest side, which is the width where no height is given.
        """
        longest = width if height is None else max(width, height)
        steps = []
        for step in self.steps:
            if step.value is None:
                kind = KINDS[step.kind]
                value = kind.default
                if value is None:
                    value = (kind.at_504 or 0.0) * (longest if kind.longest else width) / 504
                step = replace(step, value=within(kind, value))
            elif step.kind == "lowres":
                width, longest = (small_side(side, int(step.value)) for side in (width, longest))
            steps.append(step)
        return Degradation(tuple(steps))

    @property
    def partial(self) -> bool:
        """Whether a step happens to some of the photos only."""
        return any(step.some for step in self.steps)

    def __str__(self) -> str:
        if self.steps == MIXED_STEPS:
            return MIXED
        return "+".join(str(step) for step in self.steps) or NONE


MIXED_STEPS = (
    DegradationStep("blur"),
    DegradationStep("lowres", 2),
    DegradationStep("noise", 10),
    DegradationStep("jpeg", 20),
)


def parse_degradation(text: str) -> Degradation:
    """Read what happened to photos: `none`, or steps joined by `+`, which happen in the written order.

    | step | what happens | where |
    |---|---|---|
    | `jpeg:Q`, `noise:S`, `lowres:N` | a quality, sigma in levels, a factor | `degrade_sequence` |
    | `blur[:SIGMA]`, `defocus[:R]`, `motion[:LENGTH]` | one kernel, in px, on the values as stored | same |
    | `mixed` | `blur+lowres:2+noise:10+jpeg:20` | |
    | `some:STEP` | the step in half of the training photos only, at mixed strengths | `hqgs.scene.degrade` |

    Without a value, blur, defocus and motion take 2.5, 5 and 15 px for a width of 504 px and scale with the
    photo's width. ValueError names what is wrong and the values there are.
    """
    degradation = _parsed(text)
    for step in degradation.steps:
        if step.kind in NOT_MADE:
            raise ValueError(NOT_MADE[step.kind])
    return degradation


def parse_formation(text: str) -> Degradation:
    """Read what a method is told of the photos: as `parse_degradation`, and ValueError for other kinds.

    `shake`, `focus`, `exposure`, `grain` (noise) and `video` (a film's codec) stand without a value: each
    photo has its own, which is learned with the scene, or, as noise, measured before.
    """
    return check_formation(_parsed(text))


def check_formation(degradation: Degradation) -> Degradation:
    """The same; ValueError unless every step is one that a method can be told of."""
    for step in degradation.steps:
        if step.some or not KINDS[step.kind].formation:
            known = ", ".join(name for name, kind in KINDS.items() if kind.formation)
            raise ValueError(f"{step} cannot be corrected in the loss; a formation consists of {known}")
        if step.kind in OWN and step.value is not None:
            raise ValueError(f"{step}: it is measured for each photo; write {step.kind}")
    return degradation


def _parsed(text: str) -> Degradation:
    if text == NONE:
        return Degradation(())
    steps: list[DegradationStep] = []
    for part in text.split("+"):
        if part == MIXED:
            steps.extend(MIXED_STEPS)
        elif part == NONE:
            raise ValueError(f"{NONE!r} cannot be joined with others, got the degradation {text!r}")
        else:
            some = part.partition(":")[0] == SOME
            kind, colon, value = (part.partition(":")[2] if some else part).partition(":")
            steps.append(DegradationStep(kind, _number(value, part) if colon else None, some))
    return Degradation(tuple(steps))


def small_side(side: int, factor: int) -> int:
    """The side of a photo that was shrunk by `factor`, px."""
    return math.ceil(side / factor)


def within(kind: Kind, value: float) -> float:
    """The value in the kind's range, whole where the kind asks for it."""
    return min(max(float(round(value)) if kind.integer else value, kind.lowest), kind.highest)


def _number(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text!r} in the degradation {part!r} is not a number")
    return value
