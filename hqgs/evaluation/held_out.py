"""Held-out views: their renders, and their means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.metrics import psnr
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import BACKGROUND, render_view
from hqgs.scene.scene import Scene


def held_out_renders(scene: Scene, gaussians: Gaussians) -> list[NDArray[np.float32]]:
    """The held-out views [H, W, 3] as training renders them, not clamped."""
    with one_torch_thread(), torch.no_grad():
        return [
            render_view(gaussians, view.camera, gaussians.sh_degree, BACKGROUND)[0].numpy()
            for view in scene.test
        ]


def held_out_psnr(scene: Scene, renders: list[NDArray[np.float32]]) -> float:
    """Mean PSNR (dB) of renders of the held-out views. ValueError where a view has none."""
    values = [psnr(r, view.image, view.mask) for r, view in zip(renders, scene.test, strict=True)]
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        raise ValueError(f"scene {scene.name!r} has no held-out view, or one without a PSNR")
    return float(np.mean(known))


@dataclass(frozen=True)
class RenderedView:
    """A held-out view: the photo it is judged by and the trained scene's render."""

    name: str
    photo: NDArray[np.uint8] | NDArray[np.float32]  # [H, W, 3]
    render: NDArray[np.float32]  # [H, W, 3], clamped to [0, 1] by the report, never rounded for the metrics
    mask: NDArray[np.bool_] | None = None  # [H, W], True where the photo counts
    culled: int | None = None  # Gaussians that this view does not show
