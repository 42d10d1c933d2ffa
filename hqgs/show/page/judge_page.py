"""judge.html: a judgement in one file that needs no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.evaluation.constants import PATCH
from hqgs.evaluation.held_out import HeldOutViews
from hqgs.evaluation.verdict import (
    CAUSES,
    FORMS,
    LABELS,
    cause_words,
    interval_words,
    not_measured,
    quality,
    scene_words,
    short_names,
    table_rows,
    wrong_frame,
)
from hqgs.photos.pixels import png, upright
from hqgs.show.page.page import filled, pair
from hqgs.show.trust import WORST_SHOWN


def judge_page(found: dict[str, Any], judged: HeldOutViews) -> str:
    """The page as HTML: `found` is what judge.json holds, `judged` the photos and renders of the scene.

    Names from files are escaped; nothing in it is loaded from elsewhere.
    """
    one, against, protocol = found["scene"], found.get("against"), found["protocol"]
    shown = [name for name in LABELS if one["mean"][name] is not None]
    colors = ("#d0672a", "#8a5fbf", "#7a7a7a", "#b8c4d0", "#c9b458", "#2f7fc4", "#3f9b57")
    order = sorted(one["views"], key=lambda name: one["views"][name]["psnr"] or np.inf)
    chosen = [judged.names.index(name) for name in order[:12]]
    names = (Path(one["name"]).name, None) if against is None else short_names(one, against)
    return filled(
        "judge.html.j2",
        title=f"{Path(one['name']).name} on {protocol['photos']} photos",
        verdict=f"Quality: {quality(found)}.",
        heads=["", *(LABELS[name] for name in shown)],
        rows=table_rows(found, shown),
        sure=interval_words(one),
        sizes=[
            *(f"{of['name']}: {scene_words(of)}" for of in (one, against) if of is not None),
            *not_measured(one),
            *wrong_frame(one),
        ],
        parts=[
            {
                "name": CAUSES[part][0],
                "what": CAUSES[part][1],
                "percent": round(100 * share, 1),
                "color": color,
            }
            for (part, share), color in zip(one["causes"].items(), colors, strict=True)
        ],
        patch=PATCH,
        white=int(WORST_SHOWN),
        one=names[0],
        other=names[1],
        pairs=[_pair(judged, number, one["views"], against) for number in chosen],
        pairs_left=len(order) - len(chosen),
        photo_heads=["photo", *(LABELS[name] for name in shown), "causes of the error"],
        photos=[_row(name, one["views"][name], shown) for name in order],
        protocol=_protocol(protocol),
    )


def _protocol(known: dict[str, Any]) -> list[tuple[str, str]]:
    """Its lines; sizes that are equal once."""
    sizes = dict.fromkeys(f"{width} x {height} px" for width, height in known["sizes"])
    told = known | {"sizes": ", ".join(sizes), "names": ", ".join(known["names"])} | known["rules"]
    return [(key.replace("_", " "), str(value)) for key, value in told.items() if key != "rules"]


def _row(name: str, view: dict[str, Any], shown: Sequence[str]) -> list[str]:
    values = ["-" if view[metric] is None else format(view[metric], FORMS[metric]) for metric in shown]
    causes = view["causes"]
    if causes is None or not causes["mse"]:
        return [name, *values, "-"]
    return [name, *values, cause_words({part: causes[part] / causes["mse"] for part in CAUSES})]


def _pair(
    judged: HeldOutViews, number: int, views: dict[str, Any], against: dict[str, Any] | None
) -> dict[str, Any]:
    view = judged[number]
    measured = views[view.name]
    maps, causes = list[str](), measured["causes"]
    if causes is not None:
        levels = _levels(causes)
        grey = np.rint(255 * np.clip(levels / WORST_SHOWN, 0, 1))
        maps.append(_png(np.repeat(grey[..., None], 3, 2), view.quarter_turns))
        other = None if against is None else against["views"][view.name]["causes"]
        if other is not None:
            apart = (_levels(other) - levels)[..., None] / 16  # above 0: the one is nearer
            apart = apart.clip(-1, 1)
            tint = np.where(apart > 0, np.array([47, 127, 196]), np.array([200, 60, 50]))
            maps.append(_png(255 + np.abs(apart) * (tint - 255), view.quarter_turns))
    height, width = view.photo.shape[:2][:: 1 - 2 * (view.quarter_turns % 2)]
    return {**pair(view, measured), "maps": maps, "aspect": f"{width} / {height}"}


def _levels(causes: dict[str, Any]) -> NDArray[np.float64]:
    """The map of errors; 0 where masked."""
    return np.array([[0.0 if v is None else v for v in row] for row in causes["levels"]])


def _png(pixels: NDArray[np.float64], turn: int) -> str:
    shown = png(upright(np.rint(pixels).astype(np.uint8), turn))
    return "data:image/png;base64," + base64.b64encode(shown).decode()
