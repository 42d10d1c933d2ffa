"""Training photos that repeat another: the same picture from the same place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hqgs.base.text import some
from hqgs.diagnosis.coverage import Sight
from hqgs.diagnosis.scene import VISIBLE_QUALITY, Inspector
from hqgs.diagnosis.sharpness import Look
from hqgs.photos.pixels import Floats
from hqgs.scene.scene import View

SAME_PLACE = 0.5  # px of parallax
SAME_PICTURE = 1.5  # levels, root mean square: rounding and little more
PROBES = 3  # photos asked for noise and JPEG


@dataclass(frozen=True)
class Twin:
    """A photo from the same place as a sharper one."""

    index: int
    sharper: int
    moved: float  # px: the parallax between them
    off: float  # levels, root mean square, by which the pictures differ


def find_copies(
    views: Sequence[View],
    looks: Sequence[Look],
    sight: Sight,
    rank: Floats,
    gone: set[int],
    inspector: Inspector,
) -> tuple[list[Twin], list[Twin], str | None]:
    """Copies; photos from the same place with another picture; and what the photos average away.

    `rank` [N] tells how sharp the photos are. Those in `gone` are passed over. Parallax excuses a difference
    of parallax times gradient; not where the photos show noise or JPEG, which several of the same picture
    average away. Photos with different masks are no copies.
    """
    order = [int(k) for k in np.argsort(-rank, kind="stable") if int(k) not in gone]
    near = {}
    for place, k in enumerate(order):
        same_size = [j for j in order[place + 1 :] if looks[j].size == looks[k].size]
        others, parallax = sight.same_place(k, np.array(same_size, np.int64), SAME_PLACE)
        if len(others):
            near[k] = list(zip(others.tolist(), parallax.tolist(), strict=True))
    if not near:
        return [], [], None
    averaged = _averaged(views, inspector)
    copies: dict[int, Twin] = {}
    unlike: dict[int, Twin] = {}
    for k, others in near.items():
        if k in copies:
            continue
        for other, moved in others:
            if other in copies or not _same_mask(views[k], views[other]):
                continue
            off = float(np.sqrt(np.square(looks[k].samples - looks[other].samples).mean()))
            excused = 0.0 if averaged else moved * looks[k].gradient / 2**0.5
            twins = copies if off <= SAME_PICTURE + excused else unlike
            twins.setdefault(other, Twin(other, k, moved, off))
    for k in copies:
        unlike.pop(k, None)
    found, others = (sorted(twins.values(), key=lambda twin: twin.index) for twins in (copies, unlike))
    return found, others, averaged


def note_of_unlike(views: Sequence[View], unlike: Sequence[Twin], averaged: str | None) -> str:
    """Why photos from the same place were kept, for `Scene.notes`."""
    names = some([f"{views[twin.index].name} (as {views[twin.sharper].name})" for twin in unlike])
    off = float(np.median([twin.off for twin in unlike]))
    why = "" if averaged is None else f" and show {averaged}, which several photos average away"
    return (
        f"training photos from the same place as another kept, as the pictures differ by {off:.1f} levels "
        f"(median){why}: {names}"
    )


def _same_mask(a: View, b: View) -> bool:
    if a.mask is None or b.mask is None:
        return a.mask is b.mask
    return bool(np.array_equal(a.mask, b.mask))


def _averaged(views: Sequence[View], inspector: Inspector) -> str | None:
    """What several photos of the same picture average away, by the diagnosis of a few of them."""
    chosen = np.unique(np.linspace(0, len(views) - 1, PROBES).round().astype(np.int64))
    found = [inspector.inspect(views[k]).diagnosis for k in chosen]
    noises = [noise for photo in found if (noise := photo.told_noise) is not None]
    if 2 * len(noises) > len(found):
        return f"noise of {np.median(noises):.0f} levels"
    qualities = [photo.jpeg.quality for photo in found if photo.jpeg.quality is not None]
    coarse = [quality for quality in qualities if quality < VISIBLE_QUALITY]
    return f"JPEG of quality {np.median(coarse):.0f}" if 2 * len(coarse) > len(found) else None
