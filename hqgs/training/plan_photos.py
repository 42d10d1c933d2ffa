"""Which photos, and what of them, a run does without."""

from __future__ import annotations

from collections.abc import Sequence

from hqgs.training.plan import Choice, Draft


def photos(draft: Draft) -> Sequence[Choice]:
    return [
        Choice("left out", item.why, item.evidence or "", item.what, item.what) for item in draft.facts.unused
    ]


def passersby(draft: Draft) -> Sequence[Choice]:
    facts = draft.facts
    if facts.passed is None:
        return []
    if not facts.passed:
        return [Choice("none", "nothing stands in one photo while others contradict it")]
    value = f"masked in {facts.passed} of {facts.photos} photos, {facts.passing:.1%} of all pixels"
    why = "other photos show what is behind them, and not them"
    return [Choice(value, why, left_out=f"passers-by in {facts.passed} of {facts.photos} photos")]
