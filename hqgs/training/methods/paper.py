"""HQGS as the paper states it: ESFG moves the means, L1 and the SCS loss judge the render."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.photos.edges import edge_magnitude
from hqgs.photos.pixels import floats
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import part
from hqgs.training.methods.base import Method, Target, photo_tensors
from hqgs.training.methods.esfg import ESFG, FEATURES
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.state import TrainState

SCS_WEIGHT = 5.0  # in L = L1 + 5 L_SCS
SCS_CACHE_BYTES = 2**30  # of its weights (12 bytes a pixel); those of further views are computed at each step
# A render dimmer than this part of its target counts as this bright. The gradient of a cosine grows with
# 1 / |render|: without a floor one faint Gaussian in a black render would get any gradient at all.
DIMMEST = 0.01


@dataclass(frozen=True)
class ScsTarget(Target):
    """The photo with the weights of its SCS loss."""

    weights: Tensor | None  # [H, W, 3]; None: they are not kept


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

    def __init__(self, scene: Scene, seed: int) -> None:
        """ValueError for photos that are not finite, or where no pixel counts."""
        self.esfg: ESFG = ESFG(scene.train, seed)
        self.rows: Tensor = torch.zeros(0, dtype=torch.int64)  # of F', the one that each Gaussian reads, [N]
        self._room = SCS_CACHE_BYTES

    def prepare(self, view: View) -> ScsTarget:
        photo, mask = photo_tensors(view)
        size = 4 * photo.numel()
        if size > self._room:
            return ScsTarget(photo, mask, None)
        self._room -= size
        return ScsTarget(photo, mask, scs_weights(photo, mask))

    def start(self, gaussians: Gaussians, iterations: int) -> Gaussians:
        self.rows = torch.arange(len(gaussians)) % FEATURES
        return gaussians.like(gaussians.named() | {"means": self.esfg.unmodulate(gaussians.means, self.rows)})

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        return gaussians.like(gaussians.named() | {"means": self.esfg.modulate(gaussians.means, self.rows)})

    def loss(self, image: Tensor, target: ScsTarget) -> Tensor:
        loss = photometric_loss(image, target.photo, target.mask, 0.0)
        weights = scs_weights(target.photo, target.mask) if target.weights is None else target.weights
        return loss + SCS_WEIGHT * scs_loss(image, target.photo, weights)

    def rows_changed(self, state: TrainState, parents: Tensor) -> None:
        self.rows = self.rows[parents]

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "esfg", "params": list(self.esfg.parameters()), "lr": 1e-6}]

    def state_dict(self) -> dict[str, Tensor]:
        return {"rows": self.rows} | {f"esfg.{name}": t for name, t in self.esfg.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.esfg.load_state_dict(part("esfg.", state))
        self.rows = state["rows"]


def scs_weights(photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """1 - g [H, W, C] of a photo's `edge_magnitude` g, and 0 where its mask, bool [H, W], does not count."""
    with one_torch_thread():
        weights = 1 - edge_magnitude(photo, mask)
    return weights if mask is None else torch.where(mask[..., None], weights, 0.0)


def scs_loss(render: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """1 - cos(R_S, T_S) of a render and its photo, a scalar in [0, 2] (HQGS, the equation of L_SCS).

    R_S = (1 - g) * render and T_S = (1 - g) * target, the parts without edges. The cosine is over all
    elements, so that neither the brightness of the whole render nor what lies on edges changes the loss.

    It is computed as |R_S / |R_S| - T_S / |T_S||^2 / 2, which keeps its digits where the two agree. Limits: a
    black (or wholly masked) target has no direction, so the loss and its gradient are 0. Where |R_S| < 0.01
    |T_S|, 0.01 |T_S| stands for |R_S| in the cosine: a black render has loss 1 and the finite gradient
    -(1 - g) T_S / (0.01 |T_S|^2). NaN or Inf in the render gives NaN.

    Args:
        render: [H, W, C], float32 or float64, not clamped.
        target: [H, W, C], uint8 (divided by 255) or float. It gets no gradient.
        weights: [H, W, C], those of the target.
    """
    with one_torch_thread():
        a, b = ((weights * x.double()).flatten() for x in (render, floats(target)))
        norm, size = a.norm(), b.norm()
        if not size:
            return (0 * render).sum()
        length = norm.clamp(min=DIMMEST * float(size))
        e = a / length - b / size
        return (0.5 * (e @ e + 1 - (norm / length) ** 2)).to(render.dtype)
