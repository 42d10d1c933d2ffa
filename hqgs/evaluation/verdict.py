"""What a held-out PSNR means, and a judgement, in words; `found` is what judge.json holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hqgs.base.text import markdown_table
from hqgs.evaluation.constants import FINE, FOG, SCATTER
from hqgs.evaluation.intervals import with_half
from hqgs.evaluation.records import HistoryEntry
from hqgs.scene.constants import ENOUGH_SHOW

LABELS = {
    "psnr": "PSNR (dB)",
    "psnr_aligned": "colour-aligned PSNR (dB)",
    "ssim": "SSIM",
    "haarpsi": "HaarPSI",
    "lpips": "LPIPS",
    "lpips_vgg": "LPIPS (VGG)",
}
FORMS = dict.fromkeys(LABELS, ".4f") | {"psnr": ".2f", "psnr_aligned": ".2f"}
CAUSES = {
    "color": ("colour", "goes away if each channel of each photo is scaled by one factor"),
    "pose": ("pose", "goes away if each pose is refined; without --fit-cameras it counts as detail"),
    "edge": ("edge of the capture", f"pixels of Gaussians that fewer than {ENOUGH_SHOW} training photos see"),
    "fog": ("floaters", f"pixels with more than {FOG:.0%} of their colour from far in front of the surface"),
    "noise": ("noise of the photos", "which no scene can show, as far as it differs from texture"),
    "detail": ("missing detail", f"errors finer than about {2 * FINE:.0f} px"),
    "broad": ("shape and shading", "all other errors, which are coarser"),
}


def judgement(found: dict[str, Any]) -> str:
    """What the screen says."""
    one, against = found["scene"], found.get("against")
    count, which = found["protocol"]["photos"], found["protocol"]["which"]
    title = f"{one['name']} on {count} photo{'s' * (count > 1)}: {which}"
    if masked := found["protocol"]["masked"]:
        title += f"; masked pixels of {masked} photo{'s' * (masked > 1)} do not count"
    shown = [name for name in LABELS if one["mean"][name] is not None]
    lines = [markdown_table(title, ["", *(LABELS[name] for name in shown)], table_rows(found, shown)), ""]
    lines += [interval_words(one)] if count > 1 else []
    if (shown_psnr := one["mean"].get("psnr_shown")) is not None:
        lines.append(
            f"rendered with each camera's vignetting and response; without them PSNR {shown_psnr:.2f} dB"
        )
    lines += [*not_measured(one), *wrong_frame(one)]
    lines.append(scene_words(one) + ("" if against is None else f"; against {scene_words(against)}"))
    lines += [f"causes of the error: {cause_words(one['causes'])}", *worst(one)]
    if "fitted" in one:
        moved = sorted(view["moved_px"] for view in one["fitted"]["views"].values())
        lines.append(
            f"refined poses move points by {moved[len(moved) // 2]:.2f} px (median; at most {moved[-1]:.2f})"
        )
    return "\n".join([*lines, f"quality: {quality(found)}"])


def quality(found: dict[str, Any]) -> str:
    """The verdict, by the report of the run where there is one."""
    psnr, name = found["judged_by"]["psnr"], found["judged_by"]["name"]
    word, why = verdict(psnr, found["scene"])
    plain = psnr == found["scene"]["mean"]["psnr"]
    return f"{word} ({why})" + ("" if plain else f"; {psnr:.2f} dB {name}")


def table_rows(found: dict[str, Any], shown: Sequence[str]) -> list[list[str]]:
    """A line for the scene, for fitted cameras, for the other scene and for their difference."""
    one, against = found["scene"], found.get("against")
    rows = [["poses as given", *_cells(one, shown)]]
    if "fitted" in one:
        rows.append(["poses refined", *_cells(one["fitted"], shown)])
    if against is not None:
        rows += [
            [f"against {short_names(one, against)[1]}", *_cells(against, shown)],
            difference_row(found, shown),
        ]
    return rows


def short_names(one: dict[str, Any], other: dict[str, Any]) -> tuple[str, str]:
    """The last parts of two scene files' names, or all of them where those are alike."""
    last = Path(one["name"]).name, Path(other["name"]).name
    return last if last[0] != last[1] else (one["name"], other["name"])


def interval_words(one: dict[str, Any]) -> str:
    """What ± is."""
    return f"±: {one['confidence']:.0%} confidence interval of the mean; differences are taken photo by photo"


def wrong_frame(one: dict[str, Any]) -> list[str]:
    """That the scene and the cameras do not fit, where renders show nothing of the photos."""
    words = apart(one.get("worse_than_flat", 0), len(one["views"]))
    return [] if words is None else [words]


def apart(worse: int, photos: int) -> str | None:
    """What it means that so many of the renders are worse than one flat colour; None of at most half."""
    if 2 * worse <= photos:
        return None
    return (
        f"{worse} of {photos} renders have a larger error than a picture of one colour: the scene file and "
        "the cameras are of different captures, or in different frames"
    )


def not_measured(one: dict[str, Any]) -> list[str]:
    """Which metrics there are not, and why."""
    return [f"no {LABELS[metric]}: {why}" for metric, why in one["reasons"].items()]


def difference_row(found: dict[str, Any], shown: Sequence[str]) -> list[str]:
    """What the scene has over the other one; what is within its interval is no difference."""
    cells = []
    for name in shown:
        apart = found["difference"][name]
        if apart is None:
            cells.append("-")
            continue
        text = with_half(apart["mean"], apart["interval"], "+" + FORMS[name])
        better = (apart["mean"] > 0) != (name in ("lpips", "lpips_vgg"))
        word = "not significant" if not apart["sure"] else "better" if better else "worse"
        cells.append(f"{text} ({word})")
    return ["difference", *cells]


def scene_words(one: dict[str, Any]) -> str:
    """Size and cost of a scene."""
    words = f"{one['gaussians']:,} Gaussians, {one['bytes'] / 1e6:.3g} MB"
    if "render_seconds" in one:
        threads = one["threads"]
        words += (
            f", {1000 * one['render_seconds']:.0f} ms per render on {threads} thread{'s' * (threads > 1)}"
        )
    return words


def cause_words(causes: dict[str, float]) -> str:
    """The parts of the error, the largest first."""
    parts = sorted(causes.items(), key=lambda item: -item[1])
    return ", ".join(f"{CAUSES[name][0]} {share:.0%}" for name, share in parts if share >= 0.005)


def worst(one: dict[str, Any]) -> list[str]:
    """The photos with the lowest PSNR, and what it comes from there."""
    known = [(view["psnr"], name, view["causes"]) for name, view in one["views"].items() if view["psnr"]]
    lines = []
    for psnr, name, causes in sorted(known, key=lambda item: item[:2])[:3]:
        parts = {part: causes[part] / causes["mse"] for part in CAUSES}
        lines.append(f"  {name}: {psnr:.2f} dB; {cause_words(parts)}")
    return ["worst photos:", *lines] if len(known) > 1 else []


def _cells(of: dict[str, Any], shown: Sequence[str]) -> list[str]:
    return [
        "-" if of["mean"][name] is None else with_half(of["mean"][name], of["interval"][name], FORMS[name])
        for name in shown
    ]


_LEVELS = (
    (
        20.0,
        "poor",
        "below 20 dB: renders are far from the photos. Wrong poses, too few photos or a short run?",
    ),
    (25.0, "fair", "20 to 25 dB: the scene is recognisable but soft; train longer or take more photos"),
    (30.0, "good", "25 to 30 dB: details are visible"),
)
_FAR_BELOW = 1.0  # dB: by as much no two seeds of a run differ, nor what a photo's exposure does
_BEST = ("very good", "above 30 dB: at a glance it looks like the photo")


def verdict(psnr: float | None, measured: Mapping[str, Any] | None = None) -> tuple[str, str]:
    """A word, and why, for the mean PSNR of views that were held out, dB; None: it has no value.

    `measured`: what the report holds of them, which says why not.
    """
    if psnr is None and measured is not None and measured["views"]:
        return "not measured", f"PSNR: {measured['reasons']['psnr']}"
    if psnr is None:
        return "not measured", "no photo was held out: look at the renders"
    return next(((word, why) for limit, word, why in _LEVELS if psnr < limit), _BEST)


def overdone(history: Sequence[HistoryEntry]) -> str | None:
    """What to say of a run that did not end at its best, by PSNR and SSIM of held-out views; None: nothing.

    Moments at which fewer views were measured than at the end are no judges of it.
    """
    last = history[-1] if history else None
    moments = [
        (psnr, ssim, entry["iteration"])
        for entry in history
        if last is not None
        and entry.get("views") == last.get("views")
        and (psnr := entry["psnr"]) is not None
        and (ssim := entry["ssim"]) is not None
    ]
    if last is None or not moments or moments[-1][2] != last["iteration"]:
        return None
    psnr, ssim, iteration = max(moments)
    fall = psnr - moments[-1][0]
    if fall <= SCATTER or ssim <= moments[-1][1]:
        return None
    return (
        f"training was too long: held-out photos were best after iteration {iteration:,}, {fall:.1f} dB "
        "better than at the end"
    )


def fallen(psnr: float | None, flat: float | None, first: float | None) -> str | None:
    """What to say of a run that ends far below where it began; None: nothing.

    PSNR, dB, of the same views: at the end, of one flat picture of their mean colour, and of the first
    Gaussians.
    """
    if psnr is None:
        return None
    if flat is not None and psnr < flat - _FAR_BELOW:
        return (
            f"renders have a larger error than a picture of one colour ({psnr:.1f} dB, {flat:.1f} dB): "
            "poses or points do not belong to these photos, or the run was far too short"
        )
    if first is not None and psnr < first - _FAR_BELOW:
        return (
            f"the last step is worse than the first one ({psnr:.1f} dB, {first:.1f} dB): the photos "
            "contradict each other (wrong poses, moving objects or exposures that differ)"
        )
    return None


def judged_by(report: Mapping[str, Any]) -> tuple[float | None, str]:
    """The mean held-out PSNR (dB) that the verdict on a run goes by, None without one, and its name.

    Where the photos were exposed each in its own way, the held-out ones were too, and the scene cannot know
    how: brightness and tint are set aside then. Reports of older runs know the plain one alone.
    """
    mean = report["metrics"]["mean"]
    exposed = len({tuple(record["gains"]) for record in report.get("learned", [])}) > 1
    if exposed and mean.get("psnr_aligned") is not None:
        return mean["psnr_aligned"], "PSNR after each photo's brightness and tint are matched"
    shown = report["metrics"].get("psnr_shown", mean.get("psnr_shown"))
    if shown is not None:
        return mean["psnr"], f"PSNR with the cameras' vignetting and response, {shown:.1f} dB without"
    return mean["psnr"], "PSNR"


def told(report: Mapping[str, Any], metric: str, form: str) -> str | None:
    """`28.31 ± 0.42`: a mean with half its interval, where the report tells one; None without a value."""
    measured = report["metrics"]
    value, half = (measured.get(of, {}).get(metric) for of in ("mean", "interval"))
    return None if value is None else with_half(value, half, form)
