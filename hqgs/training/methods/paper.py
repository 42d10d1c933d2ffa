"""HQGS as the paper states it: ESFG moves the means, L1 and the SCS loss judge the render."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.photos.edges import edge_magnitude
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import part
from hqgs.training.config import ESFGConfig, PaperConfig
from hqgs.training.methods.base import Method, Target, photo_tensors
from hqgs.training.methods.esfg import ESFG
from hqgs.training.methods.photometric import LAMBDA_DSSIM, photometric_loss
from hqgs.training.state import TrainState

SCS_WEIGHT = 5.0  # in L = L1 + 5 L_SCS
SCS_CACHE_BYTES = 2**30  # of its weights (12 bytes a pixel); those of further views are computed at each step
# A render dimmer than this part of its target counts as this bright. The gradient of a cosine grows with
# 1 / |render|: without a floor one faint Gaussian in a black render would get any gradient at all.
DIMMEST = 0.01

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
            loss = loss + SCS_WEIGHT * scs_loss(image, target.photo, weights)
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


@dataclass(frozen=True)
class ScsWeights:
    """What does not change while a photo is trained on."""

    weights: Tensor  # [H, W, C]: 1 - g, and 0 where the photo does not count
    target_norm: float  # |T_S|, the Euclidean norm of weights * target, in the target's units

    @classmethod
    def of(
        cls, target: Tensor, g: Tensor, mask: Tensor | None = None, dtype: torch.dtype = torch.float32
    ) -> ScsWeights:
        """Of a target [H, W, C], uint8 or float, and its `edge_magnitude` g [H, W, C] or [H, W].

        `mask`: bool [H, W], True where the photo counts; `dtype`: the render's. ValueError as `scs_loss`.
        """
        if target.ndim != 3 or target.dtype not in (torch.uint8, torch.float32, torch.float64):
            raise ValueError(
                f"target: must be [H, W, C], uint8 or float, got {target.dtype} {list(target.shape)}"
            )
        if g.shape not in (target.shape, target.shape[:2]):
            wanted = f"{list(target.shape)} or {list(target.shape[:2])}"
            raise ValueError(f"g: must be {wanted} as the target, got {list(g.shape)}")
        if mask is not None and (mask.dtype != torch.bool or mask.shape != target.shape[:2]):
            wanted = list(target.shape[:2])
            raise ValueError(
                f"mask: must be bool {wanted} as the target, got {mask.dtype} {list(mask.shape)}"
            )
        weights = 1 - g.detach().to(dtype)
        weights = (weights[..., None] if g.ndim == 2 else weights).expand(target.shape)
        if mask is not None:
            weights = torch.where(mask[..., None], weights, 0.0)
        weights = weights.contiguous()
        return cls(weights, _norm(weights * target.detach()))


def scs_loss(render: Tensor, target: Tensor, fixed: ScsWeights) -> Tensor:
    """1 - cos(R_S, T_S) of a render and its photo, a scalar in [0, 2] (HQGS, the equation of L_SCS).

    R_S = (1 - g) * render and T_S = (1 - g) * target, the parts without edges. The cosine is over all
    elements, so that neither the brightness of the whole render nor what lies on edges changes the loss.

    It is computed as |R_S / |R_S| - T_S / |T_S||^2 / 2, which keeps its digits where the two agree, with sums
    in double precision; same bits for any number of threads. Limits: a black (or wholly masked) target has
    no direction, so the loss and its gradient are 0. Where |R_S| < 0.01 |T_S|, 0.01 |T_S| stands for |R_S| in
    the cosine: a black render has loss 1 and the finite gradient -(1 - g) T_S / (0.01 |T_S|^2). NaN or Inf in
    the render gives NaN.

    Args:
        render: [H, W, C], float32 or float64, not clamped.
        target: [H, W, C], uint8 (divided by 255) or float, as `fixed` was made of. It gets no gradient.

    Raises:
        ValueError: a wrong shape or dtype, with its name.
    """
    if render.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"render: must be float32 or float64, got {render.dtype}")
    if render.shape != target.shape or target.shape != fixed.weights.shape:
        raise ValueError(
            f"render: must have the shape of the target, {list(target.shape)}, and of the weights, "
            f"{list(fixed.weights.shape)}, got {list(render.shape)}"
        )
    if fixed.weights.dtype != render.dtype:
        raise ValueError(f"weights: must be {render.dtype} as the render, got {fixed.weights.dtype}")
    return _Scs.apply(render, target, fixed)


class _Scs(torch.autograd.Function):
    """With a = w R, b = w T and e = b - (|b| / |a|) a: L = |e / |b||^2 / 2 and
    dL/dR = -w (e + L (|b| / |a|) a) / (|a| |b|).
    """

    @staticmethod
    def forward(ctx: Any, render: Tensor, target: Tensor, fixed: ScsWeights) -> Tensor:
        if fixed.target_norm == 0:
            ctx.scale = 0.0
            ctx.save_for_backward(torch.zeros_like(render))
            return render.new_tensor(0.0)
        white = 255 if target.dtype == torch.uint8 else 1  # T keeps its units: they cancel
        a = fixed.weights * render
        norm = _norm(a)
        length = max(norm, DIMMEST * fixed.target_norm / white)  # NaN stays NaN
        ratio = fixed.target_norm / length
        e = target.to(render.dtype, copy=True).mul_(fixed.weights).sub_(a, alpha=ratio)
        # The last term is 0 unless the floor holds; there the gradient is -w b / (length |b|).
        loss = 0.5 * ((_norm(e) / fixed.target_norm) ** 2 + 1 - (norm / length) ** 2)
        along = loss if length == norm else 1.0
        ctx.scale = -1 / (length * fixed.target_norm)
        ctx.save_for_backward(e.add_(a, alpha=along * ratio).mul_(fixed.weights))
        return render.new_tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's own is too general)
        ctx: Any, v_loss: Tensor
    ) -> tuple[Tensor, None, None]:
        (grad,) = ctx.saved_tensors
        return grad * (v_loss * ctx.scale), None, None


def _norm(x: Tensor) -> float:
    """Euclidean norm, summed in double precision in an order of its own."""
    with one_torch_thread():
        return float(torch.linalg.vector_norm(x, dtype=torch.float64))
