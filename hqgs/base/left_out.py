"""What a run leaves out because the scene does not need it: the names, and the record of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, TypedDict, cast

if TYPE_CHECKING:
    from typing_extensions import NotRequired  # typing has it from Python 3.11 on

PHOTO = "training photo "  # and its name
CORRECTION = "a correction for "  # and the step of the formation, of what the photos do not show


class LeftOutRecord(TypedDict):
    """`LeftOut` as JSON: what is not known is not there."""

    what: str
    why: str
    evidence: NotRequired[str]
    bytes: NotRequired[int]
    cost_db: NotRequired[float]


@dataclass(frozen=True)
class LeftOut:
    """One thing that a run did without. None: not known or not measured."""

    what: str
    why: str
    evidence: str | None = None  # what was measured to decide it
    bytes: int | None = None  # of the scene file saved
    cost_db: float | None = None  # lost in PSNR on training photos that were held back; below 0: gained

    def known(self) -> LeftOutRecord:
        """The fields that are known, as plain JSON values."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        return cast(LeftOutRecord, known)


def format_left_out(items: Sequence[LeftOut]) -> str:
    """A short table of what was left out and what that saved; empty if nothing was.

    Corrections share a row: why each was not made fills a screen, and the report tells it.
    """
    rows = list[tuple[str, str, str]]()
    steps = [item.what.removeprefix(CORRECTION) for item in items if item.what.startswith(CORRECTION)]
    if steps:
        rows.append(
            ("corrections", "", f"the photos show no need of any for {', '.join(steps)}: see the report")
        )
    for item in items:
        if item.what.startswith(CORRECTION):
            continue
        saved = [] if item.bytes is None else [f"{item.bytes / 1e6:.1f} MB"]
        saved += [] if item.cost_db is None else [f"{-item.cost_db:+.2f} dB"]
        rows.append((item.what, ", ".join(saved), item.why))
    if not rows:
        return ""
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    lines = [f"  {what:{widths[0]}}  {saved:{widths[1]}}  {why}" for what, saved, why in rows]
    return "\n".join(["left out:", *lines])
