"""What a held-out PSNR means, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hqgs.evaluation.constants import SCATTER
from hqgs.evaluation.intervals import with_half
from hqgs.evaluation.records import HistoryEntry

_LEVELS = (
    (
        20.0,
        "poor",
        "below 20 dB: renders are far from the photos. Wrong poses, too few photos or a short run?",
    ),
    (25.0, "fair", "20 to 25 dB: the scene is recognisable but soft; train longer or take more photos"),
    (30.0, "good", "25 to 30 dB: details are visible"),
)
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
