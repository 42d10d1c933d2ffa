"""The rules by which a run is planned, one after the other: each changes the plan, and notes why.

A rule looks at the facts, at the diagnosis of the photos and at what the rules before it have decided; so a
plan follows from facts alone. To add one: a function of a `Draft`, and its line in `RULES` after those that
it reads. What it goes by is a field of `Facts`. Where no source is named, a number was chosen on held-back
training photos of fern, fox and horns at half size.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from hqgs.base.left_out import CORRECTION
from hqgs.base.text import some
from hqgs.diagnosis.scene import Diagnosis
from hqgs.photos.formula import (
    DEVICES,
    ERRORS,
    LEARNED,
    LINEAR,
    NONE,
    Degradation,
    film_alone,
    parse_formation,
    undegraded,
)
from hqgs.training.config import (
    AUTO,
    AUTOMATIC,
    FORMATION,
    ITEMS,
    DensifyConfig,
    TrainConfig,
    with_iterations,
)
from hqgs.training.methods.formed import HELD_PIXELS, noise_of
from hqgs.training.methods.hqgs import KNEE
from hqgs.training.methods.photometric import LAMBDA_DSSIM
from hqgs.training.plan import Facts, PlanRow, RunPlan, StepSeconds
from hqgs.training.schedule import COARSE_FACTOR, FINEST

SMALLEST_SIDE = 32  # px that must be left of a side at half size
PIXELS = 100  # of photos as photographed, for each point to start from
FEWEST_VIEWS = 10  # with fewer photos none is held back
# Iterations beyond which photos as photographed seldom gain: so many for each, LEAST_ENOUGH at least. Where
# cameras are learned, or few photos are degraded: ENOUGH.
FOR_EACH_PHOTO, LEAST_ENOUGH, ENOUGH = 150, 4_000, 7_000
FEWEST_ITERATIONS, MOST_ITERATIONS = 50, 30_000  # of a run that has a number of seconds
# A mean step of a run over one at its start; and of one that starts with more than twice the scene's own
# points: it grows little, and its Gaussians hide more of each other as they become opaque.
SLOWER, SLOWER_DENSE = 2.0, 1.0
GROWS_FROM = 140  # the iteration before which a run from points all over the photos does not grow
# Up to so many photos are few; up to so many each depth is sought twice; and the share of depths along edges
# on which photos agree that bear each other out. Measured on 29 sets of 3 to 103 photos (docs/log.md).
FEW_PHOTOS, MANY_PHOTOS, DEPTHS_AGREED = 12, 31, 0.89
DECAY = 0.005  # share of the opacities that each view takes away (Han et al. 2024: 0.995 of them stay)
DROPOUT = 0.2  # share of Gaussians left out of a step, at the end of the run (Park et al. 2025)


class Draft:
    """A plan on its way through the rules."""

    def __init__(self, facts: Facts, diagnosis: Diagnosis | None, asked: TrainConfig) -> None:
        self.facts = facts
        self.diagnosis = diagnosis
        self.asked = asked
        self.plan: RunPlan = RunPlan(asked, facts.points)
        self.rule: tuple[str, str] = ("", "")  # what the rule at work decides; its name and source

    def note(
        self, value: str, why: str, evidence: str = "", left_out: str | None = None, what: str | None = None
    ) -> None:
        """Add a row of the rule at work; `what` it decides, where that is not what the rule is called."""
        name, source = self.rule
        row = PlanRow(what or name, value, why, evidence, source, 0, left_out)
        self.change(rows=(*self.plan.rows, row))

    def change(self, **fields: Any) -> None:
        """Other values of fields of the plan."""
        self.plan = replace(self.plan, **fields)

    def set(self, **fields: Any) -> None:
        """Other values of fields of the settings."""
        self.change(settings=replace(self.settings, **fields))

    def grow(self, **fields: Any) -> None:
        """Other values of fields of the growth's settings."""
        self.set(densify=replace(self.settings.densify, **fields))

    @property
    def settings(self) -> TrainConfig:
        return self.plan.settings

    @property
    def formed(self) -> bool:
        """Whether the loss knows how the photos were made."""
        return self.settings.method == "hqgs" and self.settings.hqgs.guidance == FORMATION

    @property
    def degradation(self) -> Degradation:
        """What has happened to the photos, as far as the loss knows of it."""
        known = self.formed and self.settings.hqgs.formation != AUTO
        return parse_formation(self.settings.hqgs.formation if known else NONE)

    @property
    def kinds(self) -> frozenset[str]:
        """Of its steps."""
        return frozenset(step.kind for step in self.degradation.steps)

    @property
    def undegraded(self) -> bool:
        """Photos as photographed, or each with what its own camera did: they bear 3DGS's growth."""
        return self.formed and undegraded(self.kinds)

    @property
    def dense(self) -> bool:
        """Whether the run starts from more points than the reconstruction has."""
        return self.plan.first_points > self.facts.points


def unused_photos(draft: Draft) -> None:
    for item in draft.facts.unused:
        draft.note("left out", item.why, item.evidence or "", item.what, item.what)


def method(draft: Draft) -> None:
    if draft.asked.method != AUTO:
        draft.note(draft.asked.method, "asked for")
        return
    draft.set(method="hqgs")
    draft.note("hqgs", "the default: its loss takes the degradation of the photos into account")


def formation(draft: Draft) -> None:
    if not draft.formed:
        return
    asked, diagnosis, hqgs = draft.asked.hqgs.formation, draft.diagnosis, draft.settings.hqgs
    if asked != AUTO:
        text = str(parse_formation(asked))
        draft.note(text, "asked for")
    elif diagnosis is None:
        raise ValueError("formation is auto, which needs a diagnosis of the photos; got None")
    else:
        looks = draft.facts.looks
        out = {name for name, tried in looks.items() if not tried.pays}
        steps = [str(step) for step in parse_formation(diagnosis.formation).steps if step.kind not in out]
        text = str(parse_formation("+".join(steps) or NONE))
        found = [
            f"{name}: {why}" + (f", {looks[name]}" if name in looks else "")
            for name, needed, why in diagnosis.needs()
            if needed and name not in out
        ]
        why = "found in the photos" if found else "no degradation found that needs a correction"
        draft.note(text, why, "; ".join(found))
        for item in diagnosis.passed_over:
            draft.note("left out", item.why, what=item.what, left_out=item.what)
        for name, needed, why in diagnosis.needs():
            if not needed:
                what = CORRECTION + name
                why = why if why.startswith("not measured") else f"not needed: {why}"
                draft.note("none", why, what=what, left_out=what)
        why = "in short test runs it did not improve the validation photos"
        for name in looks:
            if name in out:
                what = f"a learned {name}"
                draft.note("none", why, str(looks[name]), what=what, left_out=what)
    draft.set(hqgs=replace(hqgs, formation=text))


def loss(draft: Draft) -> None:
    facts, has, settings = draft.facts, draft.kinds, draft.settings
    of = f"of {facts.photos} photos"
    if settings.method == "srgs":
        texture = settings.srgs.texture_weight
        value = f"{1 - texture:g} at the photos' own resolution, {texture:g} at full size"
        draft.note(value, "SRGS: renders are compared at both sizes")
    elif settings.method == "hqgs" and not draft.formed:
        draft.note("L1 + 5 SCS of modulated Gaussians", "the published form was asked for")
    elif "jpeg" in has:
        why = "a JPEG file only says in which rounding interval (cell) each DCT coefficient lies"
        draft.note(f"distance to the JPEG's cells + {settings.hqgs.jpeg_pixels:g} L1", why)
    elif "noise" in has or film_alone(has):
        why = "squared error averages the noise away; L1 and D-SSIM would fit it"
        draft.note(f"squared error up to {KNEE:g} sigma of the noise, then L1", why)
    else:
        draft.note(f"{1 - LAMBDA_DSSIM:g} L1 + {LAMBDA_DSSIM:g} D-SSIM", "the loss of 3DGS")
    if "grain" in has:
        what = f"D-SSIM in the loss of {f'{facts.noisy} {of}' if facts.noisy else 'photos with noise'}"
        draft.note("none", "D-SSIM would fit their noise", what=what, left_out=what)
    if operators := [step for step in draft.degradation.steps if step.kind in LINEAR]:
        why = "each render gets the photos' degradation before it is compared with the photo"
        draft.note("+".join(map(str, operators)), why, what="applied to renders")
    if facts.undirected:
        what = f"motion blur in the loss of {len(facts.undirected)} {of}"
        why = f"the direction of the blur could not be measured in {some(list(facts.undirected))}"
        draft.note("none", why, what=what, left_out=what)
    if own := [kind for kind in LEARNED if kind in has]:
        draft.note(", ".join(own), "different in each photo: learned together with the scene", what="cameras")


def budget(draft: Draft) -> None:
    """The most Gaussians: what degraded photos determine, what few photos can tell, or what was asked for."""
    facts, settings = draft.facts, draft.settings
    most = settings.densify.max_gaussians
    if not draft.formed or draft.undegraded or not facts.sizes:
        if (bound := bound_of_few(draft)) < most:
            draft.grow(max_gaussians=bound)
            why = "poses from few photos are inexact, and more Gaussians would overfit single photos"
            evidence = (
                f"{facts.photos} photos of {facts.pixels / 1e6:.1f} megapixels, {facts.points:,} points"
            )
            draft.note(f"{bound:,} Gaussians at most", why, evidence)
        else:
            draft.note(f"{most:,} Gaussians at most", "limits the memory")
        return
    degradation = draft.degradation
    wanted = max(gaussians_determined(facts, degradation, settings.hqgs.gaussians_per_pixel), facts.points)
    most = min(most, wanted)
    told = f"{facts.photos} photos hold the detail of {sharp_pixels(facts, degradation):,.0f} sharp pixels"
    told += f"; their files keep {facts.kept:,} DCT coefficients" if facts.kept is not None else ""
    draft.note(f"{most:,} Gaussians at most", "more Gaussians would fit noise and ringing", told)
    threshold = kept_gradient(facts, degradation, settings.densify.grad_threshold)
    if threshold != settings.densify.grad_threshold:
        why = "lower, as the loss has no gradient within a rounding interval of the JPEG"
        draft.note(f"gradient of {threshold:.2g}", why, what="densification threshold")
    draft.grow(max_gaussians=most, grad_threshold=threshold)


def bound_of_few(draft: Draft) -> int:
    """How many Gaussians few photos bear that found their own cameras, which are a little off.

    Growth then explains each photo alone, without end. Bounded so a museum of 8 and a wheel of 10 photos
    gained up to 1.1 dB; better cameras bear more.
    """
    facts = draft.facts
    few = (
        draft.formed and draft.kinds <= {"exposure", *DEVICES} and facts.found and facts.photos <= FEW_PHOTOS
    )
    most = max(40 * facts.points, facts.pixels // 50)
    return most if few else draft.settings.densify.max_gaussians


def first_points(draft: Draft) -> None:
    facts, settings, what = draft.facts, draft.settings, "first points along edges"
    own = f"the scene's own {facts.points:,}"
    if not draft.formed:
        draft.note(own, "as published")
        return
    if draft.undegraded:
        wanted, what = first_points_wanted(facts, settings), None
        why = "the scene's points lie at corners only; with points along all edges training is shorter"
    else:
        wanted = int(settings.hqgs.first_points * settings.densify.max_gaussians)
        why = "degraded photos give few points, and the limit on Gaussians leaves little room to add more"
    if not wanted:
        draft.note(own, "no more points were asked for")
    elif not facts.linked:
        draft.note(own, "the scene does not say which photos see which of its points", left_out=what)
    elif facts.points >= wanted:
        draft.note(own, f"{wanted:,} points are enough", left_out=what)
    elif facts.agreed == 0:
        draft.note(own, "no depth along an edge was confirmed by a second photo", left_out=what)
    else:
        back = facts.photos <= MANY_PHOTOS
        draft.change(first_points=wanted, found_back=back)
        where = "cross-checked between photos" if back else "along the photos' edges"
        points = f"{facts.points:,} points in the scene, {facts.pixels / 1e6:.1f} megapixels"
        draft.note(f"{wanted:,}, {where}", why, points)
    if draft.undegraded and draft.dense:
        draft.change(discs=True)
        draft.note("discs", "laid flat on the surface through their neighbours", what="first shapes")


def length(draft: Draft) -> None:
    """As many iterations as were asked for, as pay, or as fit into the seconds.

    More than pay learn what no other photo shows.
    """
    settings, facts, has = draft.settings, draft.facts, draft.kinds
    open_ended, enough, why = "iterations" in settings.leave_out, settings.iterations, ""
    if has & set(LEARNED) or (has and facts.photos < FEWEST_VIEWS):
        enough, why = ENOUGH, "no validation photo can be set aside to find the best length"
    elif draft.formed and not has:
        enough, why = (
            max(LEAST_ENOUGH, FOR_EACH_PHOTO * facts.photos),
            "more iterations seldom improve the scene",
        )
    most = enough if open_ended and enough < settings.iterations else None
    if facts.seconds is not None and settings.seconds is not None:
        _by_the_clock(draft, facts.seconds, settings.seconds, None if has else most)
    elif most is not None:
        new = with_iterations(settings, most)
        if not has and most > ENOUGH:  # held-back photos tell whether fewer do
            new = replace(new, leave_out=settings.leave_out)
        draft.change(settings=new)
        left = f"iterations {most + 1} to {settings.iterations}"
        draft.note(f"{most:,} iterations", why, f"{facts.photos} photos", left)
    else:
        why = "at most: training ends when validation photos stop improving" if open_ended else "asked for"
        if not open_ended and not has and enough < settings.iterations:
            why += f"; with {facts.photos} photos more than {enough:,} seldom improve the scene"
        draft.note(f"{settings.iterations:,} iterations", why)


def _by_the_clock(draft: Draft, step: StepSeconds, seconds: float, most: int | None) -> None:
    """As many iterations as fit into the seconds, by the steps that were timed; `most` of them at most."""
    first = draft.plan.first_points / max(draft.facts.points, 1)
    halves = starts_small(draft)
    planned = fitting(seconds, step, first, halves, most)
    fits = planned != most
    why = f"as many as fit into {seconds:g} s" if fits else "more iterations seldom improve the scene"
    half = f", {1e3 * step.half:.1f} ms at half size" if halves else ""
    draft.change(settings=with_iterations(draft.settings, planned), clock_most=most or MOST_ITERATIONS)
    draft.note(
        f"{planned:,} iterations",
        f"{why}; {'corrected' if fits else 'shortened'} after densification by the time measured",
        f"{1e3 * step.full:.1f} ms a step{half} at the start",
    )


def fitting(seconds: float, step: StepSeconds, first: float, halves: bool, most: int | None = None) -> int:
    """As many iterations as fit into `seconds`; `most` of them at most. `step`: at the start of a run from
    `first` times the scene's own points; `halves`: it starts at half size."""
    slower = SLOWER_DENSE if first > 2 else SLOWER

    def needed(iterations: int) -> float:
        half = half_size_end(iterations) if halves else 0
        return slower * (half * step.half + (iterations - half) * step.full)

    beyond = MOST_ITERATIONS if most is None else max(most, FEWEST_ITERATIONS) + 1
    return max(FEWEST_ITERATIONS, bisect_right(range(beyond), seconds, key=needed) - 1)


def half_size(draft: Draft) -> None:
    why = "coarse shapes are found as well in small photos, in less time"
    small, items = starts_small(draft), set(draft.settings.leave_out)
    items = items | {"resolution"} if small else items - {"resolution"}
    draft.set(leave_out=tuple(item for item in ITEMS if item in items))
    if small:
        end = half_size_end(draft.settings.iterations)
        draft.change(half_size_until=end)
        left = f"full resolution in the first {end} iterations"
        draft.note(f"1/{COARSE_FACTOR} of width and height until iteration {end:,}", why, left_out=left)
    else:
        why = "a start at half size was not asked for, or few points, small or degraded photos forbid it"
        draft.note("full from the start", why)


def starts_small(draft: Draft) -> bool:
    """Whether the run starts at a part of the photos' sides: asked for, or photos as photographed from points
    all over them, of which Gaussians may be left out."""
    items, facts = draft.settings.leave_out, draft.facts
    fits = facts.as_photographed and facts.shortest_side >= COARSE_FACTOR * SMALLEST_SIDE
    automatic = set(AUTOMATIC) <= set(items)
    return fits and ("resolution" in items or (draft.formed and draft.dense and automatic))


def half_size_end(iterations: int) -> int:
    """The last iteration at half size, where a run of so many starts with it."""
    return min(round(0.6 * iterations), 1_500)


def growth(draft: Draft) -> None:
    due, tried, told = draft.settings.due, draft.facts.tried, ""
    if tried is not None:
        told = f"without it {tried}; mean gain of PSNR, SSIM and HaarPSI: {tried.sure:.1f} standard errors"
    dense = draft.undegraded and draft.dense
    left, why = None, "the schedule of 3DGS, scaled to the length of the run"
    if dense and tried is not None and tried.sure > 0:  # growth, which takes time, must improve them
        draft.grow(**no_growth(draft.settings))
        why = "in short test runs added Gaussians overfitted the photos: validation photos became worse"
        draft.note("none", why, told, "densification")
        return
    if dense and due.start < GROWS_FROM:
        draft.grow(start=GROWS_FROM)
        why = "gradients show missing detail only after sizes and colours are about right"
        left = f"densification in the first {GROWS_FROM} iterations"
    start = draft.settings.due.start
    draft.note(f"every {due.every} iterations from {start:,} to {due.stop:,}", why, told, left)
    if draft.formed and not draft.undegraded and draft.settings.densify.reset_every < due.stop:
        draft.grow(reset_every=due.stop)
        what = "opacity resets"  # what one takes away seldom comes back where it was
        draft.note("none", "with a limit on Gaussians, lost ones do not come back", left_out=what, what=what)


def opacity_decay(draft: Draft) -> None:
    """What one photo alone holds up fades, where photos do not bear each other out."""
    asked, facts = draft.asked.opacity_decay, draft.facts
    if asked is not None or not draft.formed:
        if asked is not None:
            draft.note(f"{asked:g} of each opacity per view", "asked for")
        return
    agreed = "" if facts.agreed is None else f", which agree on {facts.agreed:.0%} of the depths"
    evidence = f"{facts.photos} photos{agreed}"
    many, errors = facts.photos > MANY_PHOTOS, bool(draft.kinds & ERRORS)
    softened = bool(draft.kinds & LINEAR) and not errors  # of fine detail less is left to hold up
    least = 0.8 if many else 0.85 if softened else DEPTHS_AGREED
    if many and not errors and (draft.kinds or facts.agreed is None):
        draft.note("none", "so many photos confirm the geometry, and decay would cost detail", evidence)
    elif in_agreement(facts, least) and not errors:
        draft.note("none", "the photos agree on the depths, and decay would cost detail", evidence)
    else:
        share = DECAY * min(1.0, MANY_PHOTOS / facts.photos)  # as much in a look at all photos
        draft.set(opacity_decay=share)
        cause = "errors in the photos" if errors else "photos that are few or disagree"
        why = f"fades floaters, which come from {cause}"
        draft.note(f"{share:.2g} of each opacity per view", why, evidence)


def dropout(draft: Draft) -> None:
    """Not where cameras are learned: shaken photos of the built-in room lose SSIM by it."""
    asked, photos = draft.asked.dropout, draft.facts.photos
    if asked is not None:
        draft.note(f"up to {asked:.0%} of the Gaussians hidden in a step", "asked for")
    elif draft.facts.as_photographed and draft.undegraded and photos <= 10:
        draft.set(dropout=DROPOUT)
        value = f"up to {DROPOUT:.0%} of the Gaussians hidden in a step"
        draft.note(value, "with few photos, Gaussians overfit single ones", f"{photos} photos")


def shown(draft: Draft) -> None:
    asked = draft.asked.averaged
    if asked is None and draft.formed:
        draft.set(averaged=0.05)
    if (share := draft.settings.averaged) is not None:
        why = "each step fits one photo, their mean fits all photos" if asked is None else "asked for"
        draft.note(f"mean of the last {share:.0%} of the steps", why)


def rates(draft: Draft) -> None:
    asked, has = draft.asked.faster_rates, draft.kinds
    if asked is not None or not draft.formed:
        value = "higher in short runs" if asked else "those of 3DGS"
        draft.note(value, "as published" if asked is None else "asked for")
    elif has == {"jpeg"}:
        draft.set(faster_rates=False)
        why = "higher rates would fit detail that the JPEG files do not determine"
        draft.note("those of 3DGS", why)
    else:
        draft.set(faster_rates=True)
        draft.note("higher in short runs", "the rates of 3DGS are made for 30,000 iterations")


def noise_rates(draft: Draft) -> None:
    if "noise" not in draft.kinds or "jpeg" in draft.kinds or not draft.settings.hqgs.held_pixels:
        return
    together = None if draft.diagnosis is None else draft.diagnosis.together
    if draft.asked.hqgs.formation == AUTO and together is not None:
        draft.set(hqgs=replace(draft.settings.hqgs, held_pixels=False))
        why = f"no use where noise of neighbouring pixels is correlated (here {together:.2f} or more)"
        draft.note("as planned", why, left_out="validation pixels, which warn when noise is learned")
    else:
        share = f"1/{HELD_PIXELS} of each photo's pixels"
        why = "these pixels are not trained on, and show when training starts to fit the noise"
        draft.note(f"lower when {share} stop improving", why, left_out=f"{share} in the loss")


def needless(draft: Draft) -> None:
    items, facts = set(draft.settings.leave_out), draft.facts
    if draft.kinds & set(LEARNED):
        items &= {"photos"}
    elif not facts.as_photographed:  # hqgs grows few Gaussians then: less of them saves no time
        items &= {"photos", "iterations"}
    left = tuple(item for item in ITEMS if item in items)
    draft.set(leave_out=left)
    if "growth" in items:
        why = "no photo shows finer detail"
        draft.note(f"not below {FINEST:g} px", why, what="splitting of small Gaussians")
    draft.note(
        ", ".join(left) or "nothing", "the parts of --leave-out that suit these photos and this length"
    )
    if "iterations" in left and facts.photos >= FEWEST_VIEWS:
        count = min(4, max(1, round(facts.photos / 20)))
        draft.change(held_photos=count)
        why = "show when more iterations stop helping; then they are trained on, too"
        draft.note(f"{count} of {facts.photos} at first", why, what="validation photos")


class Rule(NamedTuple):
    """How one thing is decided."""

    what: str  # it decides
    decide: Callable[[Draft], None]  # it notes nothing where it does not apply
    source: str  # paper and equation, or what chose its numbers


CHOSEN = "measured on validation photos of fern, fox and horns at half size"
FEW = "limits measured on sets of 3 to 103 photos"
OF_PHOTOS_ALONE = (  # they need no poses
    Rule("method", method, "the default of hqgs train"),
    Rule("formation", formation, "thresholds beside each measurement in hqgs/diagnosis/"),
    Rule("loss", loss, "Kerbl et al. 2023, equation 7; under noise and JPEG " + CHOSEN),
    Rule("rates under noise", noise_rates, f"for noise that is independent from pixel to pixel; {CHOSEN}"),
)
RULES = (
    Rule("a photo", unused_photos, "a broken or empty photo would add wrong colours"),
    *OF_PHOTOS_ALONE,
    Rule("budget", budget, "Candes and Donoho 2004; " + CHOSEN),
    Rule("first points", first_points, f"one for each {PIXELS} pixels, or the budget: {CHOSEN}"),
    Rule("length", length, f"{FOR_EACH_PHOTO} for each photo, {LEAST_ENOUGH:,} at least: {CHOSEN}"),
    Rule("photos' size", half_size, CHOSEN),
    Rule(
        "densification",
        growth,
        f"Kerbl et al. 2023, section 5.2; from {GROWS_FROM} on: {CHOSEN}; none: test runs",
    ),
    Rule("opacity decay", opacity_decay, f"Han et al. 2024, arXiv 2410.18822; {FEW}"),
    Rule("dropout of Gaussians", dropout, f"DropGaussian, Park et al. 2025; {FEW}"),
    Rule("scene at the end", shown, "Polyak and Juditsky 1992; " + CHOSEN),
    Rule("learning rates", rates, "learning_rates in schedule.py; " + CHOSEN),
    Rule("left out to save time", needless, "docs/results/time.md"),
)


def plan_run(
    facts: Facts, diagnosis: Diagnosis | None, asked: TrainConfig, rules: Sequence[Rule] = RULES
) -> RunPlan:
    """The plan of a run. `diagnosis`: None where nobody has looked at the photos."""
    draft = Draft(facts, diagnosis, asked)
    for rule in rules:
        draft.rule = rule.what, f"{rule.decide.__name__}: {rule.source}"
        rule.decide(draft)
    return draft.plan


def in_agreement(facts: Facts, least: float = DEPTHS_AGREED) -> bool:
    """Whether the photos bear each other out: more than FEW_PHOTOS, which agree on where things are."""
    return facts.photos > FEW_PHOTOS and facts.agreed is not None and facts.agreed >= least


def growth_in_doubt(facts: Facts, plan: RunPlan) -> bool:
    """Whether only a trial can tell if growth pays: photos as photographed, which do not bear each other out,
    and a run from more points than the reconstruction has."""
    draft = Draft(facts, None, plan.settings)
    draft.plan = plan
    return draft.undegraded and draft.dense and not in_agreement(facts)


def no_growth(settings: TrainConfig) -> dict[str, int]:
    """The fields of growth by which nothing grows, and nothing is removed."""
    return {"start": settings.due.stop, "reset_every": max(1, settings.due.stop)}


def first_points_wanted(facts: Facts, settings: TrainConfig) -> int:
    """How many points photos without a fault call for, more than the scene's own always.

    Twice as many in runs of few steps, in which little grows, where the photos agree: by that share 0.84 (a
    building) +0.54, 0.77 (a statue) +0.15, 0.68 (a can) -0.55 dB, for a fifth more time.
    """
    timed = settings.seconds is not None or settings.timed  # a repeat starts as what it repeats
    few = not timed and settings.iterations < 20 * facts.photos
    times = 2 if few and (facts.agreed or 0) >= 0.72 else 1
    most = min(times * settings.start_points, settings.densify.max_gaussians)
    return min(most, max(times * facts.pixels // PIXELS, int(1.5 * facts.points)))


def gaussians_determined(facts: Facts, formation: Degradation, per_pixel: float) -> int:
    """How many Gaussians degraded photos can determine.

    - The less the photos tell, the fewer: a share of the pixels. Blur makes a pixel count less, and a photo
      tells no more than the coefficients that its codec kept (JPEG without noise). More Gaussians paint the
      ringing of deblurring.
    - Noise: at most a multiple of E^(1/3), where E counts a pixel less for its noise. With M anisotropic
      atoms the error of a picture with edges falls as M^-2 (Candes and Donoho 2004), and that by the noise
      grows as M / E: their sum is least at an M that goes with E^(1/3).
    """
    told = sharp_pixels(facts, formation)
    if _codec_alone(facts, formation):
        told = min(told, float(facts.kept or 0))
    most = per_pixel * told
    if noise := noise_of(formation):
        most = min(most, 600 * sharp_pixels(facts, formation, noise) ** (1 / 3))
    return int(most)


def kept_gradient(facts: Facts, formation: Degradation, threshold: float) -> float:
    """The gradient that growth asks for, `threshold` but for JPEG without noise.

    There it asks for less, since within the cells there is none. A share k of coefficients outside their
    cells, of any sign, adds up to sqrt(k) of the gradient of all; the share that the codec kept stands for
    it.
    """
    if not _codec_alone(facts, formation):
        return threshold
    pixels = sum(height * width for height, width in facts.sizes)
    return min(threshold, DensifyConfig.grad_threshold * math.sqrt(min((facts.kept or 0) / pixels, 1.0)))


def _codec_alone(facts: Facts, formation: Degradation) -> bool:
    kinds = {step.kind for step in formation.steps}
    return facts.kept is not None and "jpeg" in kinds and "noise" not in kinds


def sharp_pixels(facts: Facts, formation: Degradation, noise: float = 0.0) -> float:
    """How many sharp pixels without noise would tell as much as the photos do, roughly.

    A blur of sigma px spreads a point over 4 pi sigma^2 pixels, a disc or a line over its own. Noise (its
    standard deviation, where 1 is white) of s levels asks for the mean of (s / 6)^2 more pixels until it is
    below what one pixel may be off.
    """
    factor = next((int(step.value or 1) for step in formation.steps if step.kind == "lowres"), 1)
    total = 0.0
    for height, width in facts.sizes:  # as the photo was taken
        share = 1.0 + (255 * noise / 6) ** 2
        for step in formation.for_width(width * factor).steps:
            value_in_photo = (step.value or 0.0) / factor
            if step.kind == "blur":
                share += 4 * math.pi * value_in_photo**2
            elif step.kind == "defocus":
                share += math.pi * value_in_photo**2
            elif step.kind == "motion":
                share += value_in_photo
        total += height * width / share
    return total
