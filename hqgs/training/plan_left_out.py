"""What a run does without where nothing is lost: which items it bears, and the photos held back to tell."""

from __future__ import annotations

from collections.abc import Sequence

from hqgs.photos.formula import LEARNED
from hqgs.training.config import ITEMS, OF_PHOTOS
from hqgs.training.constants import FEWEST_VIEWS, FINEST, HELD_SHARE, MOST_HELD
from hqgs.training.plan import Choice, Draft


def needless(draft: Draft) -> Sequence[Choice]:
    items, facts, has = set(draft.settings.leave_out), draft.facts, draft.kinds
    rows: list[Choice] = []
    if has & set(LEARNED):
        items &= set(OF_PHOTOS)
    elif not facts.as_photographed:  # hqgs grows few Gaussians then: less of them saves no time
        items &= {*OF_PHOTOS, "iterations"}
    left = tuple(item for item in ITEMS if item in items)
    if "growth" in items:
        why = "no photo shows more than that"
        rows.append(Choice(f"not of Gaussians below {FINEST:g} px", why, what="growth of fine ones"))
    names = ", ".join(left) or "nothing"
    why = "asked for, as far as these photos and this length bear it"
    return [*rows, Choice(names, why, changes={"leave_out": left})]


def held_photos(draft: Draft) -> Sequence[Choice]:
    count = 0
    if "iterations" in draft.settings.leave_out and draft.facts.photos >= FEWEST_VIEWS:
        count = min(MOST_HELD, max(1, round(HELD_SHARE * draft.facts.photos)))
    if not count:
        return []
    why = "they tell when more iterations no longer pay, and then come back"
    return [Choice(f"{count} of {draft.facts.photos} at first", why, changes={"held_photos": count})]
