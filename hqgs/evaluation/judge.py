"""A scene measured on photos, as `hqgs judge` does: the numbers, how sure they are, and why; and how it was
measured, as JSON values: what has to be equal before two numbers can be compared."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from hqgs._rust import EPS2D, get_num_threads
from hqgs.base.options import given
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.causes import Causes, causes, noise_of, pixel_maps, shares, shown_by
from hqgs.evaluation.constants import CONFIDENCE
from hqgs.evaluation.fit_cameras import fit_cameras
from hqgs.evaluation.held_out import HeldOutViews, held_out_renders, measured
from hqgs.evaluation.intervals import difference, half_widths
from hqgs.evaluation.metrics import METRICS, ViewMetrics, mean_metrics
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.photos.look import Look
from hqgs.photos.pixels import as_floats
from hqgs.scene.camera_files import picked
from hqgs.scene.constants import BACKGROUND, TEST_EVERY
from hqgs.scene.scene import Scene, View

Background = tuple[float, float, float]


def judge(
    name: str,
    size: int,
    gaussians: Gaussians,
    scene: Scene,
    views: Sequence[View],
    background: Background = BACKGROUND,
    fit: bool = False,
    on_stage: OnStage = silent,
    looks: Mapping[str, Look] | None = None,
) -> tuple[dict[str, Any], HeldOutViews]:
    """Measure Gaussians, held in the frame of the scene's cameras, on some of its photos.

    Returns what judge.json holds of them, and their views, which are rendered when they are asked for.

    Args:
        name, size: of the scene file; bytes.
        gaussians: in `scene.world`.
        scene: its training cameras tell where the capture ends.
        views: the photos to measure on.
        background: behind everything, R, G, B.
        fit: also with each camera fitted to the scene.
        looks: of cameras, by `View.device`: photos of these are measured in them.

    Raises:
        ValueError: no Gaussian shows from any of the cameras; or a photo and its mask do not fit.
    """
    judged_scene = replace(scene, test=[*views])
    renders = held_out_renders(judged_scene, gaussians, background=background, looks=looks)
    on_stage(Stage("photos measured", 0, len(views)))
    each = measured(renders)
    if views and not shown_by(gaussians, [view.camera for view in views]).any():
        raise ValueError(
            f"{name}: none of its {len(gaussians):,} Gaussians is in front of any camera of {scene.name}: "
            "the photos' cameras are in another frame than the scene file"
        )

    def told(done: int) -> None:
        on_stage(Stage("held-out cameras fitted", done, len(views)))

    fits = fit_cameras(views, gaussians, gaussians.sh_degree, background, told) if fit else []
    fitted = held_out_renders(
        replace(scene, test=[one.view for one in fits]), gaussians, background=background, looks=looks
    )
    sorted_errors, seconds = list[Causes | None](), list[float]()
    shown = shown_by(gaussians, [view.camera for view in scene.train])
    for k, view in enumerate(views):
        seconds.append(_seconds(gaussians, view, background))
        sorted_errors.append(_causes(renders, fitted, k, gaussians, view, shown))
        on_stage(Stage("errors sorted by their causes", k + 1, len(views)))
    worse = [one.psnr is not None and flat_psnr(v) > one.psnr for v, one in zip(views, each, strict=True)]
    known: dict[str, Any] = {
        "name": name,
        "bytes": size,
        "gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "antialiased": gaussians.antialiased,
        "worse_than_flat": sum(worse),  # photos to which one colour, their mean, is nearer than the render
        "render_seconds": median(seconds),  # of a photo, on all threads
        "threads": get_num_threads(),
        **numbers(renders.names, each),
    }
    if fits:
        moved = [{"rotation_deg": one.rotation_deg, "moved_px": one.pixels} for one in fits]
        known["fitted"] = numbers(renders.names, measured(fitted), moved)
    known["causes"] = shares([one for one in sorted_errors if one is not None])
    for of, one in zip(renders.names, sorted_errors, strict=True):
        known["views"][of]["causes"] = one
    return known, renders


def numbers(
    names: Sequence[str], each: Sequence[ViewMetrics], more: Sequence[dict[str, Any]] = ()
) -> dict[str, Any]:
    """Metrics as JSON values: their means, half the interval of each, and those of each photo."""
    mean = asdict(mean_metrics([*each]))
    reasons = mean.pop("reasons")
    if mean["psnr_shown"] is None:
        del mean["psnr_shown"]
    rows = [{key: value for key, value in asdict(one).items() if key in METRICS} for one in each]
    extra = more or [{} for _ in rows]
    views = {name: row | also for name, row, also in zip(names, rows, extra, strict=True)}
    return {
        "mean": mean,
        "interval": half_widths(rows, METRICS),
        "confidence": CONFIDENCE,
        "reasons": reasons,
        "views": views,
    }


def compared(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Each metric of one scene less that of another on the same photos, both as `judge` has them."""
    found: dict[str, Any] = {}
    for metric in METRICS:
        values = [[view[metric] for view in of["views"].values()] for of in (one, other)]
        found[metric] = difference(*values)
    return found


def flat_psnr(view: View) -> float:
    """PSNR of the photo's mean colour, dB; -inf where its mask leaves no pixel."""
    pixels = as_floats(view.image)[view.mask if view.mask is not None else ...].reshape(-1, 3)
    if not len(pixels):
        return -math.inf
    return -10 * math.log10(max(float(pixels.var(0, dtype=np.float64).mean()), 1e-10))


def _seconds(gaussians: Gaussians, view: View, background: Background) -> float:
    with one_torch_thread(), torch.no_grad():
        started = time.perf_counter()
        render_view(gaussians, view.camera, gaussians.sh_degree, background)
        return time.perf_counter() - started


def _causes(
    renders: HeldOutViews,
    fitted: HeldOutViews,
    number: int,
    gaussians: Gaussians,
    view: View,
    shown: torch.Tensor,
) -> Causes | None:
    if view.mask is not None and not view.mask.any():
        return None
    with one_torch_thread():
        maps = pixel_maps(gaussians, view.camera, shown)
    return causes(renders[number], maps, noise_of(view), fitted[number] if len(fitted) else None)


HELD_OUT, TRAINED, ALL = "test", "train", "all"
COMPARED = {  # what must be equal, in the order in which it is told
    "names": "the photos",
    "sizes": "the sizes of the photos",
    "pixels": "the photos' pixels or masks (their digest)",
    "background": "the backgrounds",
    "version": "the measuring rules",
    "looks": "whether renders have the cameras' vignetting and response (of a run that learned them)",
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
        here, there = one[key], other.get(key, {"version": 1, "looks": False}.get(key))
        if here != there:
            raise ValueError(f"{name} cannot be compared: {words} differ, {_apart(here, there)}")


def _apart(here: Any, there: Any) -> str:
    """In what two values of a protocol differ, the first of it."""
    if isinstance(here, list) and isinstance(there, list) and len(here) != len(there):
        return f"{len(here)} here and {len(there)} there"
    if isinstance(here, list) and isinstance(there, list):
        here, there = next((a, b) for a, b in zip(here, there, strict=True) if a != b)
    return f"{here} here and {there} there"
