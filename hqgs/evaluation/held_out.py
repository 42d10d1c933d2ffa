"""Held-out views: the one place that renders them, and their means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.metrics import psnr
from hqgs.model.constants import BACKGROUND
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.scene import Scene


@dataclass(frozen=True)
class RenderedView:
    """A held-out view: the photo it is judged by and the trained scene's render."""

    name: str
    photo: NDArray[np.uint8] | NDArray[np.float32]  # [H, W, 3]
    render: NDArray[np.float32]  # [H, W, 3], clamped to [0, 1] by the report, never rounded for the metrics
    mask: NDArray[np.bool_] | None = None  # [H, W], True where the photo counts
    culled: int | None = None  # Gaussians that this view does not show
    turn: int = 0  # quarter turns clockwise that show it upright


def held_out_renders(
    scene: Scene,
    gaussians: Gaussians,
    sh_degree: int | None = None,
    background: tuple[float, float, float] = BACKGROUND,
) -> list[RenderedView]:
    """The held-out views as training renders them, not clamped; `sh_degree` None: the Gaussians' own."""
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    views = []
    with one_torch_thread(), torch.no_grad():
        for view in scene.test:
            render, meta = render_view(gaussians, view.camera, degree, background)
            culled = int((meta["radii"][0] == 0).any(dim=1).sum())
            views.append(RenderedView(view.name, view.image, render.numpy(), view.mask, culled, view.turn))
    return views


def held_out_mean(metric: Callable[..., float | None], views: Sequence[RenderedView]) -> float | None:
    """Mean of `metric(render, photo, mask)`; None where there is no view, or one without a value."""
    values: list[Any] = [metric(view.render, view.photo, view.mask) for view in views]
    return float(np.mean(values)) if values and None not in values else None


def held_out_psnr(scene: Scene, views: Sequence[RenderedView]) -> float:
    """Mean PSNR (dB) of renders of the held-out views. ValueError where a view has none."""
    mean = held_out_mean(psnr, views)
    if mean is None:
        raise ValueError(f"scene {scene.name!r} has no held-out view, or one without a PSNR")
    return mean
