"""The rules by which a run is planned, in their order: one entry of `RULES` for each thing that is decided.

To add one: write a function of a `Draft` that gives a `Choice`, or none where it does not apply, and its
entry. What it goes by beside the diagnosis is a fact (`Facts`), so that a plan follows from facts alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hqgs.base.left_out import CORRECTION
from hqgs.base.text import some
from hqgs.diagnosis.scene import Diagnosis
from hqgs.photos.formula import FILM, LEARNED, LINEAR, NONE, parse_formation
from hqgs.training.config import AUTO, AUTOMATIC, ITEMS, OF_PHOTOS, TrainConfig
from hqgs.training.constants import (
    COARSE_FACTOR,
    COARSE_MOST,
    COARSE_PART,
    ENOUGH,
    FEWEST_VIEWS,
    FOR_EACH_PHOTO,
    GROWS_FROM,
    HELD_PIXELS,
    HELD_SHARE,
    KNEE,
    LAMBDA_DSSIM,
    LEAST_ENOUGH,
    MANY_PHOTOS,
    MOST_HELD,
    MOST_ITERATIONS,
    PIXELS,
    SMALLEST_SIDE,
)
from hqgs.training.plan import Choice, Draft, Facts, Rule, RunPlan, StepSeconds, plan_by
from hqgs.training.plan_budget import (
    first_points_wanted,
    gaussians_determined,
    kept_gradient,
    no_growth,
    sharp_pixels,
)
from hqgs.training.plan_left_out import held_photos, needless
from hqgs.training.plan_length import fitting, shown
from hqgs.training.plan_overfitting import WHERE, dropout, most_gaussians, opacity_decay
from hqgs.training.plan_photos import passersby, photos
from hqgs.training.schedule import half_size_end
from hqgs.training.settings import with_iterations

CHOSEN = "measured on held-back photos of fern, fox and horns at half size"


def method(draft: Draft) -> Sequence[Choice]:
    if draft.asked.method == AUTO:
        why = "it takes photos for what they are; nothing else was asked for"
        return [Choice("hqgs", why, changes={"method": "hqgs"})]
    return [Choice(draft.asked.method, "asked for")]


def formation(draft: Draft) -> Sequence[Choice]:
    if not draft.formed:
        return []
    asked, diagnosis = draft.asked.hqgs.formation, draft.diagnosis
    if asked != AUTO:
        text = str(parse_formation(asked))
        return [Choice(text, "asked for", changes={"hqgs.formation": text})]
    if diagnosis is None:
        raise ValueError("the formation is auto, and nobody has looked at the photos")
    looks = draft.facts.looks
    out = {name for name, tried in looks.items() if not tried.pays}
    steps = [str(step) for step in parse_formation(diagnosis.formation).steps if step.kind not in out]
    text = str(parse_formation("+".join(steps) or NONE))
    found = [
        f"{name}: {why}" + (f", {looks[name]}" if name in looks else "")
        for name, needed, why in diagnosis.needs()
        if needed and name not in out
    ]
    why = "what the photos show" if found else "the photos show nothing that must be undone"
    rows = [Choice(text, why, "; ".join(found), changes={"hqgs.formation": text})]
    rows += [
        Choice("left out", item.why, what=item.what, left_out=item.what) for item in diagnosis.passed_over
    ]
    unseen = [(CORRECTION + name, why) for name, needed, why in diagnosis.needs() if not needed]
    rows += [Choice("none", f"not seen: {why}", what=what, left_out=what) for what, why in unseen]
    why = "photos held back from short runs, in the look of their camera, do not gain by it"
    rows += [
        Choice("none", why, str(looks[name]), what=f"a learned {name}", left_out=f"a learned {name}")
        for name in looks
        if name in out
    ]
    return rows


def noise_rates(draft: Draft) -> Sequence[Choice]:
    if "noise" not in draft.kinds or "jpeg" in draft.kinds or not draft.settings.hqgs.held_pixels:
        return []
    together = None if draft.diagnosis is None else draft.diagnosis.together
    if draft.asked.hqgs.formation == AUTO and together is not None:
        why = f"the noise of neighbouring pixels goes together by {together:.2f} at least"
        what = "pixels held back to tell when noise is learned"
        return [Choice("as planned", why, left_out=what, changes={"hqgs.held_pixels": False})]
    share = f"1/{HELD_PIXELS} of each photo's pixels"
    why = "they tell when the scene would start to learn the noise"
    return [Choice(f"fall where {share} gain nothing", why, left_out=f"{share} in the loss")]


def loss(draft: Draft) -> Sequence[Choice]:
    facts, has = draft.facts, draft.kinds
    of = f"of {facts.photos} photos"
    if draft.settings.method == "srgs":
        texture = draft.settings.srgs.texture_weight
        value = f"{1 - texture:g} at the photos' own resolution, {texture:g} at full size"
        return [Choice(value, "SRGS: each view ties finer pixels")]
    if draft.settings.method == "hqgs" and not draft.formed:
        value = f"{draft.settings.hqgs.paper.loss} of modulated Gaussians"
        return [Choice(value, "the published form was asked for")]
    if "jpeg" in has:
        why = "a file says no more of a coefficient than the cell that it lies in"
        rows = [Choice(f"distance to the JPEG's cells + {draft.settings.hqgs.jpeg_pixels:g} L1", why)]
    elif "noise" in has or has == FILM:
        why = "the photos' mean is nearer to the truth than their median, and D-SSIM asks for the noise"
        rows = [Choice(f"squares up to {KNEE:g} sigma of the noise, then L1", why)]
    else:
        rows = [Choice(f"{1 - LAMBDA_DSSIM:g} L1 + {LAMBDA_DSSIM:g} D-SSIM", "as 3DGS has it")]
    if "grain" in has:
        what = f"D-SSIM in the loss of {f'{facts.noisy} {of}' if facts.noisy else 'photos with noise'}"
        rows.append(
            Choice("as under noise", "it asks for the noise that they have", what=what, left_out=what)
        )
    if operators := [step for step in draft.degradation.steps if step.kind in LINEAR]:
        why = "a photo is compared with what it would show of the scene"
        rows.append(Choice("+".join(map(str, operators)), why, what="renders go through"))
    if facts.undirected:
        what = f"motion in the loss of {len(facts.undirected)} {of}"
        why = f"no direction is told from {some(list(facts.undirected))}"
        rows.append(Choice("none", why, what=what, left_out=what))
    return rows


def cameras(draft: Draft) -> Sequence[Choice]:
    own = [kind for kind in LEARNED if kind in draft.kinds]
    return [Choice(", ".join(own), "each photo has its own: it is learned with the scene")] if own else []


def rates(draft: Draft) -> Sequence[Choice]:
    asked, has = draft.asked.faster_rates, draft.kinds
    if asked is not None or not draft.formed:
        value = "higher in short runs" if asked else "those of 3DGS"
        return [Choice(value, "as published" if asked is None else "asked for")]
    if has == {"jpeg"}:
        why = "what a codec leaves open is learned sooner at higher rates, and nothing holds it back"
        return [Choice("those of 3DGS", why, changes={"faster_rates": False})]
    why = "those of 3DGS suit its 30,000 iterations"
    return [Choice("higher in short runs", why, changes={"faster_rates": True})]


def first_points(draft: Draft) -> Sequence[Choice]:
    facts, settings, what = draft.facts, draft.settings, "first points along edges"
    if not draft.formed:
        return [Choice(f"the scene's own {facts.points:,}", "as published")]
    if draft.undegraded:
        wanted, what = first_points_wanted(facts, settings), None
        why = "points lie at corners alone, and a run from points all over the photos costs less"
    else:
        wanted = int(settings.hqgs.first_points * settings.densify.max_gaussians)
        why = "bad photos give few points, and under a budget little grows"
    own = f"the scene's own {facts.points:,}"
    if not wanted:
        return [Choice(own, "more were not asked for")]
    if not facts.linked:
        return [Choice(own, "the scene does not tell which photos see which of its points", left_out=what)]
    if facts.points >= wanted:
        return [Choice(own, f"it has {facts.points} points for {wanted} that are called for", left_out=what)]
    if facts.agreed == 0:
        return [Choice(own, "the photos agree on no more", left_out=what)]
    evidence = f"{facts.points:,} points of the reconstruction, {facts.pixels / 1e6:.1f} megapixels"
    back = facts.photos <= MANY_PHOTOS
    where = "found back in each other by the photos" if back else "along the photos' edges"
    changes = {"first_points": wanted, "found_back": back}
    return [Choice(f"{wanted:,}, {where}", why, evidence, changes=changes)]


def shapes(draft: Draft) -> Sequence[Choice]:
    if draft.undegraded and draft.dense:
        return [Choice("discs", "as their neighbours lie; depths are exact enough", changes={"discs": True})]
    return []


def smallest(draft: Draft) -> Sequence[Choice]:
    size = draft.settings.hqgs.smallest
    if not draft.formed or draft.undegraded or not size:
        return []
    return [Choice(f"{size:g} px of a photo", "what is finer, no photo has seen")]


def half_size(draft: Draft) -> Sequence[Choice]:
    items, facts = set(draft.settings.leave_out), draft.facts
    if draft.formed and facts.as_photographed and draft.dense and set(AUTOMATIC) - set(OF_PHOTOS) <= items:
        items.add("resolution")
    if not facts.as_photographed or facts.shortest_side < COARSE_FACTOR * SMALLEST_SIDE:
        items.discard("resolution")
    left = tuple(item for item in ITEMS if item in items)
    if "resolution" not in items:
        why = "none was asked for, or a run from few points or of small or degraded photos loses by it"
        return [Choice("full from the start", why, changes={"leave_out": left})]
    why = f"a scene takes shape at 1/{COARSE_FACTOR} of the sides"
    return [Choice(f"1/{COARSE_FACTOR} of the sides at first", why, changes={"leave_out": left})]


def length(draft: Draft) -> Sequence[Choice]:
    settings, facts, has = draft.settings, draft.facts, draft.kinds
    open_ended, enough, why = "iterations" in settings.leave_out, settings.iterations, ""
    if has & set(LEARNED) or (has and facts.photos < FEWEST_VIEWS):
        enough, why = ENOUGH, "no photo can be held back to tell when to end"
    elif draft.formed and not has:
        enough, why = max(LEAST_ENOUGH, FOR_EACH_PHOTO * facts.photos), "more looks at the photos do not pay"
    most = enough if open_ended and enough < settings.iterations else None
    if facts.seconds is not None and settings.seconds is not None:
        return [_timed(draft, facts.seconds, settings.seconds, None if has else most)]
    if most is not None:
        new = with_iterations(settings, most)
        if not has and most > ENOUGH:  # held-back photos tell whether fewer do
            new = replace(new, leave_out=settings.leave_out)
        left = f"iterations {most + 1} to {settings.iterations}"
        return [
            Choice(f"{most:,} iterations", why, f"{facts.photos} photos", left, changes={"settings": new})
        ]
    why = "at most: held-back photos tell when they no longer pay" if open_ended else "asked for"
    if not open_ended and not has and enough < settings.iterations:
        why += f"; more than {enough:,} of {facts.photos} photos seldom pay"
    return [Choice(f"{settings.iterations:,} iterations", why)]


def _timed(draft: Draft, step: StepSeconds, seconds: float, most: int | None) -> Choice:
    """As many iterations as fit into the seconds, by the steps that were timed."""
    first = draft.plan.first_points / max(draft.facts.points, 1)
    halves = "resolution" in draft.settings.leave_out
    planned = fitting(seconds, step, first, lambda n: half_size_end(n) if halves else 0, most)
    fits = planned != most
    why = f"as many as fit into {seconds:g} s" if fits else "more looks at the photos do not pay"
    half = f", {1e3 * step.half:.1f} ms at half size" if halves else ""
    return Choice(
        f"{planned:,} iterations",
        f"{why}; the clock {'corrects that' if fits else 'may end it sooner'}, after growth",
        f"{1e3 * step.full:.1f} ms a step{half} at the start",
        changes={"settings": with_iterations(draft.settings, planned), "clock_most": most or MOST_ITERATIONS},
    )


def half_size_until(draft: Draft) -> Sequence[Choice]:
    if "resolution" not in draft.settings.leave_out:
        return []
    end = half_size_end(draft.settings.iterations)
    why = f"a scene takes shape at 1/{COARSE_FACTOR} of the sides"
    left = f"full resolution in the first {end} iterations"
    return [Choice(f"until iteration {end:,}", why, left_out=left, changes={"half_size_until": end})]


def budget(draft: Draft) -> Sequence[Choice]:
    facts, settings = draft.facts, draft.settings
    growth = settings.densify
    if not draft.formed or draft.undegraded or not facts.sizes:
        return most_gaussians(draft)
    degradation = draft.degradation
    wanted = max(gaussians_determined(facts, degradation, settings.hqgs.gaussians_per_pixel), facts.points)
    most = min(growth.max_gaussians, wanted)
    told = f"{facts.photos} photos tell as much as {sharp_pixels(facts, degradation):,.0f} sharp pixels"
    rows = [
        Choice(
            f"{most:,} Gaussians at most",
            "more than the photos determine paint noise and ringing",
            told + (f"; the codec kept {facts.kept:,} coefficients" if facts.kept is not None else ""),
            changes={"densify.max_gaussians": most},
        )
    ]
    threshold = kept_gradient(facts, degradation, growth.grad_threshold)
    if threshold != growth.grad_threshold:
        rows.append(
            Choice(
                f"{threshold:.2g} of gradient",
                "within the JPEG's cells there is none, so growth asks for less",
                what="growth from",
                changes={"densify.grad_threshold": threshold},
            )
        )
    return rows


def resets(draft: Draft) -> Sequence[Choice]:
    densify = draft.settings.densify
    if draft.formed and not draft.undegraded and densify.reset_every < densify.stop:
        what, why = "resets of the opacities", "a budget of Gaussians bears none"
        return [Choice("none", why, left_out=what, changes={"densify.reset_every": densify.stop})]
    return []


def growth(draft: Draft) -> Sequence[Choice]:
    densify, tried, told = draft.settings.densify, draft.facts.tried, ""
    if tried is not None:
        told = f"without it {tried}; PSNR, SSIM and HaarPSI gain {tried.sure:.1f} times their error"
    dense = draft.undegraded and draft.dense
    if dense and tried is not None and tried.pays:
        why = "what grows explains each photo alone, and views between photos are worse"
        changes = {f"densify.{name}": value for name, value in no_growth(densify).items()}
        return [Choice("none", why, told, "growth", changes=changes)]
    if dense and densify.start < GROWS_FROM:
        why = "until sizes and colours are about right, gradients do not tell where something is missing"
        left = f"growth in the first {GROWS_FROM} iterations"
        value = _growth(GROWS_FROM, densify.stop, densify.every)
        return [Choice(value, why, told, left, changes={"densify.start": GROWS_FROM})]
    value = _growth(densify.start, densify.stop, densify.every)
    return [Choice(value, "3DGS's schedule, fitted to the length of the run", told)]


def _growth(start: int, stop: int, every: int) -> str:
    return f"every {every} iterations from {start:,} to {stop:,}"


RULES = (
    Rule("a photo", photos, "what a broken or an empty photo teaches is wrong"),
    Rule("passers-by", passersby, "limits and what chose them: hqgs/training/constants.py"),
    Rule("method", method, "the default of hqgs train", of_photos=True),
    Rule("formation", formation, "hqgs/diagnosis/, thresholds beside each measurement", of_photos=True),
    Rule("loss", loss, "Kerbl et al. 2023, equation 7; under noise and JPEG " + CHOSEN, of_photos=True),
    Rule("cameras", cameras, "shake, focus and exposure as the diagnosis tells them"),
    Rule("budget", budget, "Candes and Donoho 2004 under noise; " + CHOSEN),
    Rule(
        "first points",
        first_points,
        f"one for each {PIXELS} pixels, two in short runs, or the budget: {CHOSEN}",
    ),
    Rule("first shapes", shapes, "0.1 to 0.8 dB at 30 s on fern, fox and horns"),
    Rule("smallest Gaussian", smallest, "the 3D smoothing of Mip-Splatting, Yu et al. 2024"),
    Rule("photos' size", half_size, CHOSEN),
    Rule(
        "length",
        length,
        f"{FOR_EACH_PHOTO} for each photo, {LEAST_ENOUGH:,} at least, or {ENOUGH:,}: {CHOSEN}",
    ),
    Rule("half size", half_size_until, f"{COARSE_PART:.0%} of the run, {COARSE_MOST:,} at most: {CHOSEN}"),
    Rule("growth", growth, f"Kerbl et al. 2023, section 5.2; from {GROWS_FROM} on: {CHOSEN}; none: tried"),
    Rule("resets of the opacities", resets, "what a reset takes away seldom comes back where it was"),
    Rule("opacity decay", opacity_decay, f"Han et al. 2024, arXiv 2410.18822; {WHERE}"),
    Rule("dropout of Gaussians", dropout, f"DropGaussian, Park et al. 2025; {WHERE}"),
    Rule(
        "scene at the end",
        shown,
        "Polyak and Juditsky 1992; +0.1 dB on held-back training photos, mean of 12 runs, 11 better",
    ),
    Rule("learning rates", rates, "learning_rates in schedule.py; " + CHOSEN),
    Rule("rates under noise", noise_rates, f"white noise of a pixel tells nothing of the next; {CHOSEN}"),
    Rule("left out where needless", needless, "half the time and a third of the bytes on four scenes"),
    Rule("photos held back", held_photos, f"one of {1 / HELD_SHARE:.0f}, {MOST_HELD} at most"),
)


def plan_run(facts: Facts, diagnosis: Diagnosis | None, asked: TrainConfig) -> RunPlan:
    """The plan of a run. `diagnosis`: None where nobody has looked at the photos."""
    return plan_by(RULES, facts, diagnosis, asked)
