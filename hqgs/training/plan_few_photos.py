"""What keeps a scene of few photos from learning them by heart, and where it pays."""

from __future__ import annotations

from collections.abc import Sequence

from hqgs.training.constants import DECAY, DEPTHS_AGREED, DROPOUT, DROPOUT_PHOTOS, FEW_PHOTOS, MANY_PHOTOS
from hqgs.training.plan import Choice, Draft, Facts

WHERE = "where it pays: 25 sets of 3 to 43 photos"


def in_agreement(facts: Facts) -> bool:
    """Whether the photos bear each other out: more than FEW_PHOTOS, which agree on where things are."""
    return facts.photos > FEW_PHOTOS and facts.agreed is not None and facts.agreed >= DEPTHS_AGREED


def opacity_decay(draft: Draft) -> Sequence[Choice]:
    asked, facts = draft.asked.opacity_decay, draft.facts
    if asked is not None or not draft.undegraded:
        return [] if asked is None else [Choice(f"{asked:g} of the opacities for each view", "asked for")]
    agreed = "" if facts.agreed is None else f", which agree on {facts.agreed:.0%} of the depths"
    evidence = f"{facts.photos} photos{agreed}"
    if facts.photos > MANY_PHOTOS:
        return [Choice("none", "so many photos bear out what is there, and it would cost detail", evidence)]
    if in_agreement(facts):
        return [Choice("none", "the photos agree on where things are, and it would cost detail", evidence)]
    why = "what few photos bear out would hang in the air between them"
    return [
        Choice(f"{DECAY:g} of the opacities for each view", why, evidence, changes={"opacity_decay": DECAY})
    ]


def dropout(draft: Draft) -> Sequence[Choice]:
    """Not where cameras are learned: shaken photos of the built-in room lose SSIM by it."""
    asked, photos = draft.asked.dropout, draft.facts.photos
    if asked is not None:
        return [Choice(f"up to {asked:.0%} of the Gaussians in a step", "asked for")]
    if not draft.facts.as_photographed or not draft.undegraded or photos > DROPOUT_PHOTOS:
        return []
    why = "no Gaussian may explain a photo alone"
    value = f"up to {DROPOUT:.0%} of the Gaussians in a step"
    return [Choice(value, why, f"{photos} photos", changes={"dropout": DROPOUT})]
