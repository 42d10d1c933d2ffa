"""What degraded the photos of a scene, and which parts of the method that calls for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hqgs.base.evenly import evenly
from hqgs.base.left_out import DIAGNOSIS, LeftOut
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.state import own_state
from hqgs.base.threads import of_each
from hqgs.diagnosis.colors import (
    DeviceSigns,
    SharedColors,
    device_findings,
    device_signs,
    exposure_finding,
    log_gains,
    shared_colors,
)
from hqgs.diagnosis.differences import shake_finding
from hqgs.diagnosis.focus import MOST_PHOTOS, focus_finding
from hqgs.diagnosis.photo import Finding, Inspected, PhotoDiagnosis, conclude, inspect_photo
from hqgs.photos.formula import DEVICES, KINDS, NONE, parse_formation, within
from hqgs.scene.constants import MAX_WORKERS
from hqgs.scene.scene import Scene, View

SCENE_WHITE = 0.2  # up to this correlation of neighbours, noise counts as white
# Of `fine_detail`; crf 36 leaves 0.15 to 0.25, crf 28 0.2 to 0.45, sharp photos have 0.3 to 0.5.
COARSE_FILM = 0.24


T = TypeVar("T")
_HEAD = ("photo", "size", "enlarged", "jpeg", "blocking", "noise", "blur")


@dataclass(frozen=True)
class Diagnosis:
    """What degraded a scene's training photos. `asdict` makes it JSON."""

    scene: str
    formation: str  # the degradation that best explains the photos, as `parse_formation` reads it
    parts: tuple[Finding, ...]  # in the order of the formation
    photos: tuple[PhotoDiagnosis, ...]  # those looked at
    passed_over: tuple[LeftOut, ...]  # looks that photos were spared, since others stand for them

    @property
    def together(self) -> float | None:
        """How far neighbours go together in the photos' noise; None where it is white, or not told."""
        together = _correlation(self.photos)
        return together if together > SCENE_WHITE else None

    def needs(self) -> list[tuple[str, bool, str]]:
        """Per part: its name, whether the method needs it, and why, in one sentence."""
        return [(part.name, part.needed, part.reason) for part in self.parts]

    def __str__(self) -> str:
        """One row per photo, the formation, and per part whether it is needed and why."""
        rows = [_HEAD, *(_row(photo) for photo in self.photos)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(_HEAD))]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        lines += ["", f"{self.scene}: {self.formation}"]
        for name, needed, reason in self.needs():
            lines.append(f"  {name:11}{'needed    ' if needed else 'not needed'}  {reason}")
        lines += [f"  left out: {item.what}: {item.why}" for item in self.passed_over]
        return "\n".join(lines)


class Inspector:
    """Looks at photos, at each once however often it is asked for.

    It holds what it has seen of their pixels: keep it no longer than a run needs to start. `on_stage` hears
    each photo.
    """

    def __init__(self, on_stage: OnStage = silent) -> None:
        self.on_stage: OnStage = on_stage
        self._known: dict[tuple[Any, ...], tuple[Sequence[object], Any]] = {}
        self.last: Diagnosis | None = None  # that was made

    def _once(self, make: Callable[[], T], what: object, of: Sequence[object]) -> T:
        """What `make` makes of things, by their identity; they are kept beside it: no others get it."""
        key = what, *map(id, of)
        if key not in self._known:
            self._known[key] = of, make()
        return self._known[key][1]

    def inspect(self, view: View) -> Inspected:
        """`inspect_photo` of a view."""
        given = view.name, view.image, view.low, view.film
        return self._once(lambda: inspect_photo(*given), "photo", [view])

    def log_gains(self, scene: Scene, beside: Collection[str] = ()) -> NDArray[np.float64] | None:
        """`hqgs.diagnosis.colors.log_gains` of the training photos, beside these kinds of what cameras do."""
        shared, signs = self._by_colors(scene)
        if shared is None:
            return None
        kinds = tuple(kind for kind in DEVICES if kind in beside)
        told = shared if signs is None else signs.undone(shared, kinds)
        return self._once(lambda: log_gains(scene, told), ("gains", kinds), scene.train)

    def device_signs(self, scene: Scene) -> DeviceSigns | None:
        """`hqgs.diagnosis.colors.device_signs` of the training photos."""
        return self._by_colors(scene)[1]

    def _by_colors(self, scene: Scene) -> tuple[SharedColors | None, DeviceSigns | None]:
        def told() -> tuple[SharedColors | None, DeviceSigns | None]:
            shared = shared_colors(scene)
            return shared, None if shared is None else device_signs(scene.train, shared)

        return self._once(told, "colors", scene.train)

    def diagnose(self, scene: Scene, max_photos: int = 16) -> Diagnosis:
        """As `diagnose_scene`."""
        if max_photos < 1:
            raise ValueError(f"max_photos is {max_photos}, wanted at least 1")
        chosen = evenly(len(scene.train), max_photos)
        found: list[Inspected] = []
        for inspected in of_each(self.inspect, [scene.train[k] for k in chosen], MAX_WORKERS):
            found.append(inspected)
            self.on_stage(Stage("photos diagnosed", len(found), len(chosen)))
        photos = self._once(lambda: tuple(conclude(found)), "photos", found)
        own = self._once(lambda: self._own(scene, photos), "own", scene.train)
        film = _video(photos)
        if film.needed:  # its codec takes more of some frames than of others
            why = "; strong compression of the film causes that"
            looks = (replace(p, step=None, reason=p.reason + why) if p.needed else p for p in own[-2:])
            own = *own[:-2], *looks
        *_, shake, focus = own
        blur = _blur(photos)
        if unlike := [part.name for part in (shake, focus) if part.needed]:
            reason = f"it differs from photo to photo: see {' and '.join(unlike)}"
            blur = replace(blur, step=None, reason=reason)
        faults = blur, _lowres(photos), _noise(photos)
        jpeg = _jpeg(photos, alone=not any(part.needed for part in (*faults, film)))
        parts = (*own, *faults, jpeg, film)
        text = "+".join(part.step for part in parts if part.step is not None) or NONE
        passed_over = _passed_over(scene.of or len(scene.train), len(photos))
        self.last = Diagnosis(scene.name, str(parse_formation(text)), parts, photos, passed_over)
        return self.last

    def _own(self, scene: Scene, photos: Sequence[PhotoDiagnosis]) -> tuple[Finding, ...]:
        """What photos and cameras have of their own."""
        shake = shake_finding(scene)
        devices = device_findings(self.device_signs(scene))
        beside = [device.name for device in devices if device.needed]
        exposure = exposure_finding(self.log_gains(scene, beside), photos)
        return exposure, *devices, shake, focus_finding(scene, shake.needed)


@own_state(grad=True)
def diagnose_scene(scene: Scene, max_photos: int = 16) -> Diagnosis:
    """Diagnose up to `max_photos` training photos, spread over the scene, and sum them up by medians.

    A part that lies below its threshold, in the median of the photos that tell of it, or that most show
    nothing of, is left out of the formation: when in doubt, "none". Under JPEG of visible quality noise and
    blur come from the coefficients of all photos together. ValueError for `max_photos` below 1, or a bad
    photo, which is named.
    """
    return Inspector().diagnose(scene, max_photos)


def _passed_over(total: int, looked_at: int) -> tuple[LeftOut, ...]:
    """What was not looked at of `total` photos."""
    spread = "measured photos are spread over the scene"
    looks = []
    if looked_at < total:
        what = f"{DIAGNOSIS}{total - looked_at} of {total} photos"
        looks.append(LeftOut(what, f"the {looked_at} {spread}"))
    if total > MOST_PHOTOS:
        what = f"{DIAGNOSIS}focus in {total - MOST_PHOTOS} of {total} photos"
        looks.append(LeftOut(what, f"the {MOST_PHOTOS} {spread}"))
    return tuple(looks)


def _lowres(photos: Sequence[PhotoDiagnosis]) -> Finding:
    factors = [photo.enlargement.factor for photo in photos]
    factor, count = Counter(factors).most_common(1)[0]
    known = all(photo.enlargement.evidence is None for photo in photos)
    of = f"{count} of {len(photos)} photos"
    if factor == 1 or 2 * count <= len(photos):
        reason = (
            f"{len(photos) - factors.count(1)} of {len(photos)} photos show the pixel grid of an enlargement"
        )
        return Finding("lowres", reason, None, 1.0, _spread_of(factors))
    small = next(photo.enlargement for photo in photos if photo.enlargement.factor == factor)
    size = f"{small.width} x {small.height}"
    at_hand = f"the original small photos of about {size} px are there"
    how = at_hand if known else f"{of} show the pixel grid of a smaller photo"
    reason = f"enlarged by {factor}: {how}"
    return Finding("lowres", reason, f"lowres:{factor}", float(factor), _spread_of(factors))


def _jpeg(photos: Sequence[PhotoDiagnosis], alone: bool) -> Finding:
    qualities = [photo.jpeg.quality for photo in photos if photo.jpeg.quality is not None]
    of = f"{len(qualities)} of {len(photos)} photos show JPEG quantisation"
    if 2 * len(qualities) <= len(photos):
        return Finding("jpeg", of)
    quality = float(np.median(qualities))
    spread = _spread_of(qualities)
    limit = 25 if alone else 85  # where blur, noise or an enlargement is undone
    if quality >= limit:
        reason = f"quality {quality:.0f} needs no correction (needed below {limit})"
        return Finding("jpeg", reason, None, quality, spread)
    (row, column), _ = Counter(photo.jpeg.phase for photo in photos if photo.jpeg.quality).most_common(1)[0]
    if (row, column) != (0, 0):
        reason = (
            f"{of}, with blocks that start at row {row}, column {column}: cropped since, cannot be corrected"
        )
        return Finding("jpeg", reason, None, quality, spread)
    return Finding("jpeg", f"{of} of quality {quality:.0f}", f"jpeg:{quality:.0f}", quality, spread)


def _video(photos: Sequence[PhotoDiagnosis]) -> Finding:
    details = [photo.film for photo in photos if photo.film is not None]
    reason = f"{len(details)} of {len(photos)} photos are frames of a film"
    if 2 * len(details) <= len(photos):
        return Finding("video", reason)
    detail, spread = float(np.median(details)), _spread_of(details)
    reason += f"; their finest details are {detail:.2f} times as strong as coarser ones"
    coarse = detail < COARSE_FILM
    reason += "" if coarse else f" (needed below {COARSE_FILM:g})"
    return Finding("video", reason, "video" if coarse else None, detail, spread)


def _noise(photos: Sequence[PhotoDiagnosis]) -> Finding:
    known = [(photo.noise, photo.noise_limit) for photo in photos if photo.noise is not None]
    if not known:
        return Finding(
            "noise", "not measured: the photos are too small, or too much of them is black or white"
        )
    level, limit = (float(value) for value in np.median(known, axis=0))
    spread = None if _pooled(photos) else _spread_of([noise for noise, _ in known])
    noisy = sum(photo.told_noise is not None for photo in photos)
    quiet, loud = np.quantile([max(noise, 0.5 * least) for noise, least in known], [0.1, 0.9])
    together = _correlation(photos)
    kind, more = "white noise of", ""
    if together > SCENE_WHITE:
        kind = "noise of at least"
        more = f"; correlated between neighbouring pixels ({together:.2f} or more)"
    # times the noise of the quieter photos in the noisier ones: each has its own
    if spread is not None and noisy > 0.1 * len(known) and loud >= 2.5 * quiet:
        reason = f"{kind} {quiet:.1f} levels in some photos and {loud:.1f} in others{more}"
        return Finding("noise", reason, "grain", level, spread)
    if level >= limit:
        return Finding("noise", f"{kind} {level:.1f} levels{more}", f"noise:{level:.0f}", level, spread)
    if spread is None:
        reason = f"less than {limit:.0f} levels, which JPEG compression hides"
    else:
        reason = f"{level:.1f} levels could be fine texture (needed from {limit:g})"
    return Finding("noise", reason, None, level, spread)


def _blur(photos: Sequence[PhotoDiagnosis]) -> Finding:
    blurs = [photo.blur for photo in photos if photo.blur is not None]
    if not blurs:
        return Finding("blur", "not measured: the photos are too small")
    sigma = float(np.median([blur.sigma for blur in blurs]))
    least = float(np.median([photo.blur_limit for photo in photos]))
    kind, count = Counter(blur.kind for blur in blurs).most_common(1)[0]
    kind = kind if 2 * count > len(blurs) else "gaussian"
    amounts = [b.sigma for b in blurs] if kind == "gaussian" else [b.amount for b in blurs if b.kind == kind]
    amount = float(np.median(amounts))
    spread = None if _pooled(photos) else _spread_of(amounts)
    if sigma < least:
        blurred = sum(blur.sigma >= least for blur in blurs)
        reason = f"sigma {sigma:.1f} px, as in sharp photos (needed from {least:.1f} px)"
        reason += f"; {blurred} of {len(blurs)} photos are blurred" if blurred else ""
        return Finding("blur", reason, None, sigma, spread)
    name, unit = {
        "gaussian": ("blur", "sigma"),
        "defocus": ("defocus", "radius"),
        "motion": ("motion", "length"),
    }[kind]
    step = f"{name}:{within(KINDS[name], round(amount, 1)):g}"  # enlarged ones may have more
    reason = f"the spectra fall off as after {kind} blur of {unit} {amount:.1f} px"
    return Finding("blur", reason, step, amount, spread)


def _correlation(photos: Sequence[PhotoDiagnosis]) -> float:
    """Of neighbours in the noise, the median over photos in which noise is told; 0: it is told in none."""
    known = [p.correlation for p in photos if p.told_noise is not None and p.correlation is not None]
    return float(np.median(known)) if known else 0.0


def _pooled(photos: Sequence[PhotoDiagnosis]) -> bool:
    return 2 * sum(photo.hiding for photo in photos) > len(photos)


def _spread_of(values: Sequence[float]) -> float:
    """1.4826 times the median distance from the median: a normal distribution's standard deviation."""
    return float(1.4826 * np.median(np.abs(np.asarray(values) - np.median(values))))


def _row(photo: PhotoDiagnosis) -> tuple[str, ...]:
    small = photo.enlargement
    enlarged = "no" if small.factor == 1 else f"x{small.factor} from {small.width} x {small.height}"
    if photo.noise is None:
        noise = "?"
    elif photo.noise == 0:
        noise = f"< {photo.noise_limit:.0f}"
    else:
        noise = f"{photo.noise:.1f}"
    blur = "?" if photo.blur is None else f"{photo.blur.kind} {photo.blur.amount:.2f} px"
    if photo.blur is not None and photo.blur.direction is not None:
        blur += f" at {photo.blur.direction:.0f} deg"
    quality = "no" if photo.jpeg.quality is None else str(photo.jpeg.quality)
    size = f"{photo.width} x {photo.height}"
    return photo.name, size, enlarged, quality, f"{photo.jpeg.blocking:.2f}", noise, blur
