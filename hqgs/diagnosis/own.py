"""What differs from photo to photo, or from camera to camera, and whether a run must learn it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.constants import DIFFERS, GOES_WITH_DEPTH, PAYS, TURNED, UNLIKE, UNLIKE_GAINS
from hqgs.diagnosis.devices import DeviceSigns
from hqgs.diagnosis.differences import unlike_sharpness
from hqgs.diagnosis.focus import focus_signs
from hqgs.diagnosis.photo import PhotoDiagnosis
from hqgs.photos.formula import DEVICES
from hqgs.scene.scene import Scene

NO_CAMERA = {
    "vignetting": "is brighter towards corners, or loses more than two stops there, which no lens does",
    "response": "is no curve that rises, which no sensor does",
}


@dataclass(frozen=True)
class Finding:
    """One step of how the photos were made, and whether the method must undo it."""

    name: str  # "exposure", "shake", "focus", "blur", "lowres", "noise", "jpeg" or "video"
    needed: bool
    value: float | None  # median over photos: px, factor, levels or quality; None: not told
    spread: float | None  # robust standard deviation over photos; None: estimated from all of them together
    step: str | None  # in the grammar of `parse_formation`, where needed
    reason: str  # one sentence


def exposure_finding(log_gains: NDArray[np.float64] | None, photos: Sequence[PhotoDiagnosis]) -> Finding:
    """`log_gains` [N, 3], as `hqgs.diagnosis.gains` tells them."""
    if log_gains is None:
        return Finding("exposure", False, None, None, None, "the photos share too few points to tell")
    spread = float(np.std(log_gains, axis=0).max())
    reason = f"gains differ by {spread:.1%} from photo to photo"
    # Noise that black and white cut off brightens the dark parts of a photo, and darkens the bright ones.
    noises = [noise for photo in photos if (noise := photo.told_noise) is not None]
    least = UNLIKE_GAINS + (0.5 * max(noises) / 255 if noises else 0.0)
    if spread < least:
        return Finding("exposure", False, spread, None, None, f"{reason} (needed from {least:.0%})")
    return Finding("exposure", True, spread, None, "exposure", reason)


def device_findings(signs: DeviceSigns | None) -> tuple[Finding, Finding]:
    """Vignetting and response."""
    if signs is None:
        why = "no camera is told to have taken enough of the photos"
        vignetting, response = (Finding(name, False, None, None, None, why) for name in DEVICES)
        return vignetting, response
    found: list[Finding] = []
    for name, less, more in zip(DEVICES, (signs.vignetting, signs.response), signs.unbounded, strict=True):
        needed = less >= PAYS[name]
        reason = f"with each camera's {name} photos that were held back agree better by {less:.1%}"
        reason += "" if needed else f" (needed from {PAYS[name]:.0%})"
        if more >= PAYS[name] and less < more / 2:
            needed = False
            reason = f"what would let photos agree better by {more:.1%} {NO_CAMERA[name]}; it counts as light"
            reason += " that changes, a flash or reflections"
        found.append(Finding(name, needed, less, None, name if needed else None, reason))
    return found[0], found[1]


def shake_finding(scene: Scene) -> Finding:
    unlike = unlike_sharpness(scene)
    if unlike is None:
        return Finding("shake", False, None, None, None, "the photos are too few or too small to tell")
    reason = f"photos differ by {unlike.sharpness:.2f} in sharpness, by {unlike.direction:.2f} in direction"
    if unlike.sharpness < UNLIKE or unlike.direction < TURNED:
        reason += f" (needed from {UNLIKE:g} and {TURNED:g} in the logarithm of the power of fine details)"
        return Finding("shake", False, unlike.sharpness, None, None, reason)
    return Finding("shake", True, unlike.sharpness, None, "shake", reason)


def focus_finding(scene: Scene, shaken: bool) -> Finding:
    """`shaken`: photos then differ in sharpness as a whole, whatever their focus."""
    signs = focus_signs(scene)
    if signs is None:
        return Finding("focus", False, None, None, None, "the photos share too few points to tell")
    needed = signs.with_depth >= GOES_WITH_DEPTH or (signs.in_all >= DIFFERS and not shaken)
    reason = (
        f"points are sharper or softer from photo to photo by {signs.with_depth:.2f} with their distance and "
        f"by {signs.in_all:.2f} in all"
    )
    if not needed:
        reason += f" (needed from {GOES_WITH_DEPTH:g} or {DIFFERS:g} in the logarithm of contrast)"
    return Finding("focus", needed, signs.with_depth, None, "focus" if needed else None, reason)
