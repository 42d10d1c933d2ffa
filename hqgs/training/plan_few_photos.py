"""What keeps a scene of few photos from learning them by heart, and where it pays."""

from __future__ import annotations

from collections.abc import Sequence

from hqgs.training.plan import Choice, Draft, Facts

DECAY = 0.005  # share of the opacities that each view takes away (Han et al. 2024: 0.995 of them stay)
DROPOUT = 0.2  # share of Gaussians left out of a step, at the end of the run (Park et al. 2025)
# Measured on 25 sets of 3 to 43 photos of 14 captures and rooms, 1,000 iterations at 400 px. With at most
# 12 photos decay gained in all 10 sets, 0.05 to 1.3 dB. From 13 to 31 it gained 0.3 to 1.4 dB in 8 sets whose
# photos agreed on less than 0.89 of the depths, nothing in one, and lost 0.5 in one; nothing in the two that
# agreed on more (fern loses 0.4 dB in 2,500 iterations). From 33 on it lost 0.3 to 0.6 dB in all three.
# Degraded photos lost 0.1 dB (a room, 12 photos, lowres:4): a budget bounds what they can learn by heart.
FEW, MANY, AGREED = 12, 31, 0.89
FEWEST = 10  # photos, up to which dropout gained beside decay: 0.3 to 1.0 dB (alone it lost 0.4 with 12)
WHERE = "where it pays: 25 sets of 3 to 43 photos"


def in_agreement(facts: Facts) -> bool:
    """Whether the photos bear each other out: more than FEW, which agree on where things are."""
    return facts.photos > FEW and facts.agreed is not None and facts.agreed >= AGREED


def opacity_decay(draft: Draft) -> Sequence[Choice]:
    asked, facts = draft.asked.opacity_decay, draft.facts
    if asked is not None or not draft.undegraded:
        return [] if asked is None else [Choice(f"{asked:g} of the opacities for each view", "asked for")]
    agreed = "" if facts.agreed is None else f", which agree on {facts.agreed:.0%} of the depths"
    evidence = f"{facts.photos} photos{agreed}"
    if facts.photos > MANY:
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
    if not draft.facts.as_photographed or not draft.undegraded or photos > FEWEST:
        return []
    why = "no Gaussian may explain a photo alone"
    value = f"up to {DROPOUT:.0%} of the Gaussians in a step"
    return [Choice(value, why, f"{photos} photos", changes={"dropout": DROPOUT})]
