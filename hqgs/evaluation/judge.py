"""A scene measured on photos, as `hqgs judge` does: the numbers, how sure they are, and why."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from statistics import median
from typing import Any

import numpy as np
import torch

from hqgs._rust import get_num_threads
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
from hqgs.scene.constants import BACKGROUND
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
        apart = difference(*values)
        known = (
            None if apart is None else {"mean": apart.mean, "interval": apart.half_width, "sure": apart.sure}
        )
        found[metric] = known
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
