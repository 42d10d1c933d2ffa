"""How a scene was measured, as JSON values: what has to be equal before two numbers can be compared."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hqgs._rust import EPS2D
from hqgs.base.options import given
from hqgs.evaluation.constants import CONFIDENCE
from hqgs.scene.camera_files import picked
from hqgs.scene.constants import TEST_EVERY
from hqgs.scene.scene import Scene, View

HELD_OUT, TRAINED, ALL = "test", "train", "all"
COMPARED = {  # what must be equal, in the order in which it is told
    "names": "the photos",
    "sizes": "the sizes of the photos",
    "pixels": "the photos' pixels or masks (their digest)",
    "background": "the backgrounds",
    "version": "the measuring rules",
}
VERSION = 1  # of RULES: raised where numbers come to differ; a judge.json without one is of the first
RULES = {
    "color": "sRGB values as the photos store them, white is 1; renders clamped to 0..1, not rounded",
    "cameras": "pinholes; distorted photos undistorted on load",
    "low_pass": f"{EPS2D:g} px^2 on projected covariances; compensated if the scene file says so",
    "psnr": "-10 log10 of the mean squared error over all unmasked pixels and channels; mean over photos",
    "psnr_aligned": "after one factor for each photo and channel, by least squares",
    "ssim": "11 x 11 Gaussian window of sigma 1.5, zero padding, mean over channels; mean over photos",
    "haarpsi": "Reisenhofer et al. 2018, in colour; mean over photos",
    "lpips": "v0.1; mean over photos",
    "masks": "masked pixels do not count for PSNR, and are the photo's own for the other metrics",
    "interval": f"Student's t, {CONFIDENCE:.0%}, over photos, at least as wide as on other scenes with as "
    "many photos; of a difference, paired by photo",
}


def protocol_of(
    scene: Scene, which: str, views: Sequence[View], background: Sequence[float]
) -> dict[str, Any]:
    """What was measured on which photos, and how."""
    origin = scene.origin or {}
    return {
        "photos": len(views),
        "which": told_which(scene, which),
        "names": [view.name for view in views],
        "sizes": [[view.camera.width, view.camera.height] for view in views],
        "pixels": digest_of(views),
        "masked": sum(view.mask is not None for view in views),
        "background": [*background],
        "downscale": given(origin.get("downscale"), 1.0),
        "longest": origin.get("longest"),
        "version": VERSION,
        "rules": RULES,
    }


def told_which(scene: Scene, which: str) -> str:
    """Which photos were measured on, in words."""
    every = 0 if scene.origin is None else given(scene.origin.get("test_every"), TEST_EVERY)
    rule = f"every {every}th by name, unless the scene has a split" if every else "as the scene has them"
    return {HELD_OUT: f"held out ({rule})", TRAINED: "training photos", ALL: "all, training photos too"}.get(
        which, "as named"
    )


def chosen_views(scene: Scene, which: str) -> list[View]:
    """The scene's views that `which` means, as `picked`; ValueError where there is none."""
    if which == HELD_OUT and not scene.test:
        raise ValueError(
            f"{scene.name} has no held-out photo to measure with; --views all measures on all of them"
        )
    return picked(scene.train, scene.test, which, scene.name)


def digest_of(views: Sequence[View]) -> str:
    """Of the photos' pixels and masks."""
    sha = hashlib.sha256()
    for view in views:
        for array in (view.image, view.mask):
            if array is not None:
                sha.update(f"{view.name} {array.dtype} {array.shape}".encode())
                sha.update(np.ascontiguousarray(array).data)
    return sha.hexdigest()[:16]


def read_judgement(path: Path) -> dict[str, Any]:
    """A judge.json of before. ValueError where it is none."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        if not all(isinstance(known[key], dict) for key in ("protocol", "scene")):
            raise TypeError("protocol and scene must be objects")
        values = known["scene"]["views"], known["scene"]["mean"], known["protocol"]["names"]
        if not all(isinstance(value, kind) for value, kind in zip(values, (dict, dict, list), strict=True)):
            raise TypeError("views and mean must be objects, names a list")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is not a judge.json: {error!r}") from error
    return known


def check_comparable(one: Mapping[str, Any], other: Mapping[str, Any], name: str) -> None:
    """ValueError that says by name what keeps the numbers of two protocols from being compared."""
    for key, words in COMPARED.items():
        here, there = one[key], other.get(key, 1 if key == "version" else None)
        if here != there:
            raise ValueError(f"{name} cannot be compared: {words} differ, {_apart(here, there)}")


def _apart(here: Any, there: Any) -> str:
    """In what two values of a protocol differ, the first of it."""
    if isinstance(here, list) and isinstance(there, list) and len(here) != len(there):
        return f"{len(here)} here and {len(there)} there"
    if isinstance(here, list) and isinstance(there, list):
        here, there = next((a, b) for a, b in zip(here, there, strict=True) if a != b)
    return f"{here} here and {there} there"
