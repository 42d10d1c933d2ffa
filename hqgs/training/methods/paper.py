"""HQGS as the paper states it: ESFG moves the means, L1 and the SCS loss judge the render."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.photos.edges import edge_magnitude
from hqgs.scene.scene import Scene, View
from hqgs.training.config import ESFGConfig, PaperConfig
from hqgs.training.methods.base import Plain, ThreeDGS, photo_tensors
from hqgs.training.methods.esfg import ESFG, FeatureRows
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.methods.scs import ScsWeights, weighted_scs_loss

SCS_WEIGHT = 5.0  # in L = L1 + 5 L_SCS
CACHE_BYTES = 2**30  # of SCS weights (12 bytes a pixel); those of further views are computed at each step
ROWS = ("rows.rows", "rows.place", "rows.look")  # names in the state
VARIANTS = {
    "V1": PaperConfig(None, "l1+dssim"),
    "V2": PaperConfig(ESFGConfig(eaf=False, concat=False, cross_attention=False), "l1+dssim"),
    "V3": PaperConfig(ESFGConfig(saf=False, concat=False, cross_attention=False), "l1+dssim"),
    "V4": PaperConfig(ESFGConfig(concat=False, cross_attention=False), "l1+dssim"),
    "V5": PaperConfig(ESFGConfig(cross_attention=False), "l1+dssim"),
    "V6": PaperConfig(ESFGConfig(), "l1+dssim"),
    "V7": PaperConfig(),
}


class PaperHQGS(Plain):
    """HQGS (ICLR 2025) from its equations; where its released code differs, the paper holds.

    A modulated mean is about 1.5 times as far from the frame's origin as the trained one, so the cloud that
    COLMAP gives would start too large. The first call of `modulate` therefore moves the first Gaussians, in
    place, to where modulation takes them back to that cloud. From then on it changes nothing in place.
    """

    name = "hqgs"

    def __init__(self, scene: Scene, seed: int, config: PaperConfig | None = None) -> None:
        """ValueError for photos that are not finite, or where no pixel counts."""
        self.config = PaperConfig() if config is None else config
        esfg = self.config.esfg
        self.esfg = None if esfg is None else ESFG(scene.train, seed, esfg)
        self.rows = None if esfg is None else FeatureRows(esfg.feature_size)
        self._cache: dict[str, tuple[NDArray[Any], ScsWeights]] = {}  # by name, with the photo they are of

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        if self.esfg is None or self.rows is None:
            return gaussians
        if self.rows.rows is None:
            start = self.esfg.unmodulate(gaussians.means, self.rows.start(gaussians))
            with torch.no_grad():
                gaussians.means.copy_(start)
        means = self.esfg.modulate(gaussians.means, self.rows.of(gaussians))
        return Gaussians(**(gaussians.named() | {"means": means}))

    def loss(self, render: Tensor, view: View) -> Tensor:
        image, mask = photo_tensors(view)
        dssim = ThreeDGS.LAMBDA_DSSIM if self.config.loss == "l1+dssim" else 0.0
        loss = photometric_loss(render, image, mask=mask, lambda_dssim=dssim)
        if self.config.loss == "l1+scs":
            loss = loss + SCS_WEIGHT * weighted_scs_loss(render, image, self._scs_weights_of(view))
        return loss

    def param_groups(self) -> list[dict[str, Any]]:
        if self.esfg is None:
            return []
        return [{"name": "esfg", "params": list(self.esfg.parameters()), "lr": self.esfg.config.lr}]

    def state_dict(self) -> dict[str, Tensor]:
        if self.esfg is None or self.rows is None:
            return {}
        state = {f"esfg.{name}": tensor for name, tensor in self.esfg.state_dict().items()}
        return state | {f"rows.{name}": tensor for name, tensor in self.rows.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """ValueError where the state is that of another variant."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {n.removeprefix(prefix): t for n, t in state.items() if n.startswith(prefix)}

        free = ROWS if self.esfg is not None else ()  # there are none before the first step
        here = {name: t.shape for name, t in self.state_dict().items() if name not in free}
        there = {name: t.shape for name, t in state.items() if name not in free}
        if here != there:
            odd = sorted({name for name, _ in here.items() ^ there.items()})
            raise ValueError(f"the checkpoint is that of another variant; tensors that differ: {odd}")
        if self.esfg is not None and self.rows is not None:
            self.esfg.load_state_dict(part("esfg."))
            self.rows.load_state_dict(part("rows."))

    def _scs_weights_of(self, view: View) -> ScsWeights:
        """The weights of a training view, kept while there is room."""
        image, weights = self._cache.get(view.name, (None, None))
        if weights is not None and image is view.image:
            return weights
        photo, mask = photo_tensors(view)
        with one_torch_thread():
            weights = ScsWeights.of(photo, edge_magnitude(photo, mask), mask)
        used = sum(kept.weights.nbytes for _, kept in self._cache.values())
        if used + weights.weights.nbytes <= CACHE_BYTES:
            self._cache[view.name] = (view.image, weights)
        return weights
