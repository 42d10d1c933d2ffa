"""What keeps a scene from learning its photos by heart, and where it pays."""

from __future__ import annotations

from collections.abc import Sequence

from hqgs.photos.formula import ERRORS
from hqgs.training.constants import (
    DECAY,
    DEPTHS_AGREED,
    DROPOUT,
    DROPOUT_PHOTOS,
    FEW_PHOTOS,
    MANY_AGREED,
    MANY_PHOTOS,
    PIXELS_EACH,
    POINT_GAUSSIANS,
    SOFT_AGREED,
)
from hqgs.training.plan import Choice, Draft, Facts

WHERE = "where it pays: 29 sets of 3 to 103 photos"


def in_agreement(facts: Facts, least: float = DEPTHS_AGREED) -> bool:
    """Whether the photos bear each other out: more than FEW_PHOTOS, which agree on where things are."""
    return facts.photos > FEW_PHOTOS and facts.agreed is not None and facts.agreed >= least


def opacity_decay(draft: Draft) -> Sequence[Choice]:
    asked, facts = draft.asked.opacity_decay, draft.facts
    if asked is not None or not draft.formed:
        return [] if asked is None else [Choice(f"{asked:g} of the opacities for each view", "asked for")]
    agreed = "" if facts.agreed is None else f", which agree on {facts.agreed:.0%} of the depths"
    evidence = f"{facts.photos} photos{agreed}"
    many, errors = facts.photos > MANY_PHOTOS, bool(draft.kinds & ERRORS)
    if many and not errors and (draft.kinds or facts.agreed is None):
        return [Choice("none", "so many photos bear out what is there, and it would cost detail", evidence)]
    least = MANY_AGREED if many else SOFT_AGREED if draft.softened else DEPTHS_AGREED
    if in_agreement(facts, least) and not errors:
        return [Choice("none", "the photos agree on where things are, and it would cost detail", evidence)]
    asks = "the photos' errors ask for" if errors else "few photos bear out"
    why = f"what {asks} would hang in the air between them"
    share = DECAY * min(1.0, MANY_PHOTOS / facts.photos)
    return [
        Choice(f"{share:.2g} of the opacities for each view", why, evidence, changes={"opacity_decay": share})
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


def most_gaussians(draft: Draft) -> Sequence[Choice]:
    """Cameras that few photos found are a little off: growth then explains each photo alone, without end."""
    facts, most = draft.facts, draft.settings.densify.max_gaussians
    few = draft.formed and draft.kinds <= {"exposure"} and facts.found and facts.photos <= FEW_PHOTOS
    if not few or (bound := max(POINT_GAUSSIANS * facts.points, facts.pixels // PIXELS_EACH)) >= most:
        return [Choice(f"{most:,} Gaussians at most", "it bounds the memory")]
    why = "more explain each photo alone: cameras found from so few are a little off"
    evidence = f"{facts.photos} photos of {facts.pixels / 1e6:.1f} megapixels, {facts.points:,} points"
    return [Choice(f"{bound:,} Gaussians at most", why, evidence, changes={"densify.max_gaussians": bound})]
