"""Row `deblur`: the essence of BAD-Gaussians (Zhao et al. 2024, arXiv 2403.11831).

A photo is the mean of VIRTUAL sharp renders along a path of its camera, a cubic B-spline of four knots in
se(3), learned for each photo with 3DGS's loss and growth; the mean is that of the values as they are stored,
as published. A step so costs about VIRTUAL times one of 3dgs.

Not as published: the mean of a path stays at the photo's pose, so that held-out cameras stay valid; 5 renders
in the place of 10, a sample for each 1.5 px of a way of 6 px; and rates for short runs, where the published
1e-3 to 1e-5 was no better on held-back training photos (fern, shake).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.measure import Training, train
from benchmarks.patches import RENDER_VIEW
from benchmarks.protocol import Row
from hqgs.model.gaussians import Gaussians
from hqgs.model.rasterization import RasterizationMeta, rasterization
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import TrainConfig
from hqgs.training.methods import MAKERS
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.methods.cameras import Shot, no_shot

VIRTUAL, KNOTS = 5, 4  # renders of a photo; knots of its path
RATE, LAST_RATE = 2e-3, 2e-4  # of Adam at the beginning and at the end of the run: rad, and scene extents
FIRST = 1e-5  # standard deviation of the knots at the start: from 0 a path has no direction to grow in


@dataclass(frozen=True)
class RivalRow(Row):
    """A row that may be of this method; its configuration then is that of 3dgs."""

    rival: Literal["", "deblur"] = ""

    @property
    def more(self) -> dict[str, Any]:
        """Runs of another form of it do not count: this file is no part of `sources`."""
        if not self.rival:
            return super().more
        form = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]
        return super().more | {"rival": self.rival, "form": form}


class Deblur(ThreeDGS):
    """3DGS whose renders are taken along the paths of the photos' cameras."""

    def __init__(self, scene: Scene, config: TrainConfig) -> None:
        self._extent = scene.extent
        self._numbers = {view.name: k for k, view in enumerate(scene.train)}
        random = torch.Generator().manual_seed(config.seed)
        size = len(scene.train), KNOTS, 6
        first = FIRST * torch.randn(size, generator=random, dtype=torch.float64)
        self.knots = [knots.clone().requires_grad_() for knots in first]  # turns in rad, moves in extents
        self._shown = 0  # the photo whose turn it is

    def shot(self, view: View, target: Any) -> Shot:
        self._shown = self._numbers[view.name]
        return no_shot(view)

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "paths", "params": self.knots, "lr": RATE}]

    def rates(self, part: float) -> dict[str, float]:
        return {"paths": RATE ** (1 - part) * LAST_RATE**part}

    def viewmats(self, number: int, camera: Camera) -> Tensor:
        """World to camera along the path of a photo, [VIRTUAL, 4, 4]."""
        t = torch.linspace(0, 1, VIRTUAL, dtype=torch.float64)
        weights = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
        steps = torch.stack(weights, dim=1) @ self.knots[number] / 6
        steps = steps - steps.mean(dim=0)
        x, y, z, *moves = steps.unbind(dim=1)
        a, b, c = (self._extent * move for move in moves)
        o = torch.zeros_like(x)
        twists = torch.stack([o, -z, y, a, z, o, -x, b, -y, x, o, c, o, o, o, o], dim=1).view(-1, 4, 4)
        return torch.linalg.matrix_exp(twists) @ torch.from_numpy(camera.viewmat)

    def render(
        self, gaussians: Gaussians, camera: Camera, sh_degree: int, background: Sequence[float], eps2d: float
    ) -> tuple[Tensor, RasterizationMeta]:
        """In the place of `hqgs.model.render.render_view`, for the view that `shot` was last asked for."""
        images, _, meta = rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.activated_scales(),
            gaussians.activated_opacities(),
            (gaussians.sh0, gaussians.shN) if sh_degree else gaussians.sh0,
            self.viewmats(self._shown, camera),
            torch.from_numpy(camera.K).expand(VIRTUAL, 3, 3),
            camera.width,
            camera.height,
            sh_degree=sh_degree,
            eps2d=eps2d,
            packed=False,
            backgrounds=torch.tensor([[*background]] * VIRTUAL, dtype=gaussians.means.dtype),
        )
        # Growth goes by how the loss changes when a Gaussian moves in all renders alike.
        moved = torch.zeros_like(meta["means2d"][:1]).requires_grad_()

        def add_up(gradient: Tensor) -> None:
            moved.backward(gradient.sum(dim=0, keepdim=True))  # which its own hooks see

        if meta["means2d"].requires_grad:
            meta["means2d"].register_hook(add_up)
        meta["means2d"], meta["radii"] = moved, meta["radii"].amax(dim=0, keepdim=True)
        return images.mean(dim=0), meta


def train_deblur(photos: Scene, config: TrainConfig) -> Training:
    """A run of it, with the configuration of a run of 3dgs."""
    method = Deblur(photos, config)
    with patch.dict(MAKERS, {"3dgs": lambda *_: method}), patch.object(*RENDER_VIEW, method.render):
        return train(photos, config)
