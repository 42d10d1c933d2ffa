"""HQGS as the paper states it: ESFG moves the means, L1 and the SCS loss judge the render."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.photos.edges import edge_magnitude
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import part
from hqgs.training.config import ESFGConfig, PaperConfig
from hqgs.training.constants import SCS_CACHE_BYTES, SCS_WEIGHT
from hqgs.training.methods.base import Method, Target, photo_tensors
from hqgs.training.methods.esfg import ESFG
from hqgs.training.methods.photometric import LAMBDA_DSSIM, photometric_loss
from hqgs.training.methods.scs import ScsWeights, weighted_scs_loss
from hqgs.training.state import TrainState

VARIANTS = {
    "V1": PaperConfig(None, "l1+dssim"),
    "V2": PaperConfig(ESFGConfig(eaf=False, concat=False, cross_attention=False), "l1+dssim"),
    "V3": PaperConfig(ESFGConfig(saf=False, concat=False, cross_attention=False), "l1+dssim"),
    "V4": PaperConfig(ESFGConfig(concat=False, cross_attention=False), "l1+dssim"),
    "V5": PaperConfig(ESFGConfig(cross_attention=False), "l1+dssim"),
    "V6": PaperConfig(ESFGConfig(), "l1+dssim"),
    "V7": PaperConfig(),
}


@dataclass(frozen=True)
class ScsTarget(Target):
    """The photo with the weights of its SCS loss."""

    weights: ScsWeights | None  # None: they are not kept, or there is no such loss


class PaperHQGS(Method[ScsTarget]):
    """HQGS (ICLR 2025) from its equations; where its released code differs, the paper holds.

    A modulated mean is about 1.5 times as far from the frame's origin as the trained one, so the cloud that
    COLMAP gives would start too large. `start` therefore moves the first Gaussians to where modulation takes
    them back to that cloud.

    They read the rows of F' in turn: it is replicated as often as needed. From then on the row is a
    Gaussian's for life, however many are pruned before it, and those that are cloned or split from it
    inherit it. (A row chosen by the present position would not do: a Gaussian that crosses into another
    cell, or its child, would jump by a few per cent of the scene.)
    """

    name = "hqgs"

    def __init__(self, scene: Scene, seed: int, config: PaperConfig | None = None) -> None:
        """ValueError for photos that are not finite, or where no pixel counts."""
        self.config: PaperConfig = PaperConfig() if config is None else config
        esfg = self.config.esfg
        self.esfg: ESFG | None = None if esfg is None else ESFG(scene.train, seed, esfg)
        self.rows: Tensor = torch.zeros(0, dtype=torch.int64)  # of F', the one that each Gaussian reads, [N]
        self._room = SCS_CACHE_BYTES

    def prepare(self, view: View) -> ScsTarget:
        photo, mask = photo_tensors(view)
        size = 4 * photo.numel()
        if self.config.loss != "l1+scs" or size > self._room:
            return ScsTarget(photo, mask, None)
        self._room -= size
        return ScsTarget(photo, mask, _scs_weights(photo, mask))

    def start(self, gaussians: Gaussians, iterations: int) -> Gaussians:
        if self.esfg is None:
            return gaussians
        self.rows = torch.arange(len(gaussians)) % self.esfg.config.feature_size
        means = self.esfg.unmodulate(gaussians.means, self.rows)
        return replace(gaussians, means=means)

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        if self.esfg is None:
            return gaussians
        return replace(gaussians, means=self.esfg.modulate(gaussians.means, self.rows))

    def loss(self, image: Tensor, target: ScsTarget) -> Tensor:
        dssim = LAMBDA_DSSIM if self.config.loss == "l1+dssim" else 0.0
        loss = photometric_loss(image, target.photo, target.mask, dssim)
        if self.config.loss == "l1+scs":
            weights = target.weights or _scs_weights(target.photo, target.mask)
            loss = loss + SCS_WEIGHT * weighted_scs_loss(image, target.photo, weights)
        return loss

    def rows_changed(self, state: TrainState, parents: Tensor) -> None:
        if self.esfg is not None:
            self.rows = self.rows[parents]

    def param_groups(self) -> list[dict[str, Any]]:
        if self.esfg is None:
            return []
        return [{"name": "esfg", "params": list(self.esfg.parameters()), "lr": self.esfg.config.lr}]

    def state_dict(self) -> dict[str, Tensor]:
        if self.esfg is None:
            return {}
        return {"rows": self.rows} | {f"esfg.{name}": t for name, t in self.esfg.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """ValueError where the state is that of another variant."""
        here = {name: t.shape for name, t in self.state_dict().items() if name != "rows"}
        there = {name: t.shape for name, t in state.items() if name != "rows"}
        if here != there:
            odd = sorted({name for name, _ in here.items() ^ there.items()})
            raise ValueError(f"the checkpoint is that of another variant; tensors that differ: {odd}")
        if self.esfg is not None:
            self.esfg.load_state_dict(part("esfg.", state))
            self.rows = state["rows"]


def _scs_weights(photo: Tensor, mask: Tensor | None) -> ScsWeights:
    with one_torch_thread():
        return ScsWeights.of(photo, edge_magnitude(photo, mask), mask)
