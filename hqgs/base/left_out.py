"""What a run leaves out because the scene does not need it: the names, and the record of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from hqgs.base.text import some

PHOTO = "training photo "  # and its name
CORRECTION = "a correction for "  # and the step of the formation, of what the photos do not show
DIAGNOSIS = "diagnosis of "  # and what was not measured in each photo
MOST_ROWS = 5  # on the screen
Row = tuple[str, str]  # what, why


@dataclass(frozen=True)
class LeftOut:
    """One thing that a run did without. None: not known or not measured."""

    what: str
    why: str
    evidence: str | None = None  # what was measured to decide it

    def known(self) -> dict[str, str]:
        """The fields that are known, as JSON values."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def format_left_out(items: Sequence[LeftOut]) -> str:
    """A table of at most MOST_ROWS of what was left out, and why; empty if nothing was.

    Photos come first, then what else changes the scene, last what only saved time. The report has all of it.
    """
    photos, rows, steps, looks = dict[str, list[str]](), list[Row](), list[str](), list[Row]()
    for item in items:
        if item.what.startswith(PHOTO):
            photos.setdefault(item.why, []).append(item.what.removeprefix(PHOTO))
        elif item.what.startswith(CORRECTION):
            steps.append(item.what.removeprefix(CORRECTION))
        else:
            found = looks if item.what.startswith(DIAGNOSIS) else rows
            found.append((item.what, item.why))
    gone = [(f"training photos: {len(names)}", f"{some(names)}: {why}") for why, names in photos.items()]
    needless = [("corrections", f"not needed for {', '.join(steps)}")] if steps else []
    rows = [*gone, *rows, *needless, *looks]
    if not rows:
        return ""
    if len(rows) > MOST_ROWS:
        rest = len(rows) - MOST_ROWS + 1
        rows = [*rows[:-rest], (f"and {rest} more", "the report has them all")]
    width = max(len(what) for what, _ in rows)
    lines = [f"  {what:{width}}  {why}" for what, why in rows]
    return "\n".join(["left out:", *lines])
