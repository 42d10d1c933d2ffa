"""What happened to photos as a formula: `blur:2.5+jpeg:10`, parsed and printed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Kind:
    """The values that one kind of step takes."""

    lowest: float
    highest: float
    unit: str
    integer: bool = False
    at_504: float | None = None  # the value where none is written, in px of a photo 504 px wide


KINDS = {
    "jpeg": Kind(1, 95, "a quality", integer=True),
    "noise": Kind(0.01, 255, "a standard deviation, where white is 255"),
    "lowres": Kind(2, 16, "a factor", integer=True),
    "blur": Kind(0.1, 50, "sigma in px", at_504=2.5),
    "defocus": Kind(0.5, 50, "a radius in px", at_504=5.0),
    "motion": Kind(1, 200, "a length in px", at_504=15.0),
}
NONE, MIXED = "none", "mixed"


@dataclass(frozen=True)
class Step:
    """One step. ValueError for an unknown kind, or a value outside the kind's range."""

    kind: str
    value: float | None = None  # None: the default, which scales with the photo's width

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(
                f"unknown degradation {self.kind!r}; there are: {', '.join([*KINDS, MIXED, NONE])}, and "
                "steps joined by +"
            )
        kind = KINDS[self.kind]
        wanted = f"{kind.unit}, {'an integer in ' if kind.integer else ''}{kind.lowest:g}..{kind.highest:g}"
        if self.value is None:
            if kind.at_504 is None:
                raise ValueError(f"{self.kind} needs a value: {self.kind}:VALUE with {wanted}")
        elif not kind.lowest <= self.value <= kind.highest or (kind.integer and self.value % 1):
            raise ValueError(f"{self.kind} is {self.value:g}, wanted {wanted}")

    def __str__(self) -> str:
        return self.kind if self.value is None else f"{self.kind}:{_shortest(self.value)}"


@dataclass(frozen=True)
class Degradation:
    """Steps in the order in which they happen; none for a clean photo. `str()` is what the parser reads."""

    steps: tuple[Step, ...]

    def for_width(self, width: int) -> Degradation:
        """The same with a value in every step, for photos `width` px wide.

        A default scales with the width of the picture that its step meets, within the kind's range.
        """
        steps = []
        for step in self.steps:
            if step.value is None:
                kind = KINDS[step.kind]
                value = (kind.at_504 or 0.0) * width / 504
                step = replace(step, value=min(max(value, kind.lowest), kind.highest))
            elif step.kind == "lowres":
                width = small_side(width, int(step.value))
            steps.append(step)
        return Degradation(tuple(steps))

    def __str__(self) -> str:
        if self.steps == MIXED_STEPS:
            return MIXED
        return "+".join(str(step) for step in self.steps) or NONE


MIXED_STEPS = (Step("blur"), Step("lowres", 2), Step("noise", 10), Step("jpeg", 20))


def parse_degradation(text: str) -> Degradation:
    """Read `jpeg:Q`, `noise:S`, `lowres:N`, `blur[:SIGMA]`, `defocus[:R]`, `motion[:LENGTH]` or `none`.

    Steps joined by `+` happen in the written order: `blur:2+jpeg:20`. `mixed` stands for
    `blur+lowres:2+noise:10+jpeg:20`. Without a value, blur, defocus and motion take 2.5, 5 and 15 px for a
    width of 504 px and scale with the photo's width. ValueError names what is wrong and the values there are.
    """
    if text == NONE:
        return Degradation(())
    steps: list[Step] = []
    for part in text.split("+"):
        if part == MIXED:
            steps.extend(MIXED_STEPS)
        elif part == NONE:
            raise ValueError(f"{NONE!r} stands alone, got the degradation {text!r}")
        else:
            kind, colon, value = part.partition(":")
            steps.append(Step(kind, _number(value, part) if colon else None))
    return Degradation(tuple(steps))


def small_side(side: int, factor: int) -> int:
    """The side of a photo that was shrunk by `factor`, px."""
    return math.ceil(side / factor)


def _number(text: str, part: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text!r} in the degradation {part!r} is no number")
    return value


def _shortest(value: float) -> str:
    """The shortest text that reads back as `value`."""
    return repr(int(value)) if value == int(value) else repr(float(value))
