"""HQGS as the paper states it: ESFG moves the means, L1 and the SCS loss judge the render."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.photos.pixels import floats
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import part
from hqgs.training.methods.base import Method, Target, photo_tensors
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.state import TrainState

SCS_CACHE_BYTES = 2**30  # of its weights (12 bytes a pixel); those of further views are computed at each step
# A render dimmer than this part of its target counts as this bright. The gradient of a cosine grows with
# 1 / |render|: without a floor one faint Gaussian in a black render would get any gradient at all.
DIMMEST = 0.01
HIDDEN = 64  # units of the one hidden layer of an MLP; the paper names no size
FEATURES = 1000  # F, the rows of F'
XYZ = 3  # F' feeds the sigmoid directly, so every feature has one number for each coordinate


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
        return loss + 5 * scs_loss(image, target.photo, weights)

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


class ESFG(nn.Module):
    """The fused feature F' [F, 3] of all training photos, and the positions that it modulates.

    What the paper leaves open is settled so:
    - Fixed size. I and E of each view are averaged over blocks of 2 x 2, then each view's counted pixels, row
      by row, into F / 2 runs, then those of all views into F / 2 tokens [F / 2, 3]. This works for any number
      of views of any sizes. The tokens never change, which makes a training step cheap.
    - The MLPs act on tokens: 3 -> 64 -> 3 with a ReLU, one for each branch.
    - Attention is over tokens, with one head and learned 3 x 3 projections for Q, K and V.
    - The frame. mu is taken relative to the mean of the training cameras' centres, to which COLMAP's own
      normalisation moves the origin (up to outliers): mu' = mu + sigmoid(F') (mu - center). A scale of the
      frame would cancel. So shifting the world or changing its unit changes nothing. Turning the world does,
      since the sigmoid acts on each axis.
    """

    photo_tokens: Tensor  # [T, 3], from I
    edge_tokens: Tensor  # [T, 3], from E
    center: Tensor  # [3], world units

    def __init__(self, views: Sequence[View], seed: int) -> None:
        """`views`: all training views. `seed`: of the initial weights.

        Raises ValueError if no pixel of any view counts.
        """
        super().__init__()
        centers = np.mean([view.camera.center for view in views], axis=0)
        self.register_buffer("center", torch.from_numpy(centers).float(), persistent=False)
        with one_torch_thread():
            for name, tokens in zip(("photo", "edge"), _tokens(views, FEATURES // 2), strict=True):
                self.register_buffer(f"{name}_tokens", tokens, persistent=False)
        self.saf: nn.Sequential = nn.Sequential(_linear(XYZ, HIDDEN), nn.ReLU(), _linear(HIDDEN, XYZ))
        self.eaf: nn.Sequential = nn.Sequential(_linear(XYZ, HIDDEN), nn.ReLU(), _linear(HIDDEN, XYZ))
        self.query: nn.Linear = _linear(XYZ, XYZ, bias=False)
        self.key: nn.Linear = _linear(XYZ, XYZ, bias=False)
        self.value: nn.Linear = _linear(XYZ, XYZ, bias=False)
        self._initialise(seed)

    def forward(self) -> Tensor:
        """F' [F, 3]: what the edges' feature attends to of the photos', and the edges' feature."""
        saf, eaf = self.saf(self.photo_tokens), self.eaf(self.edge_tokens)
        q, k, v = self.query(eaf), self.key(saf), self.value(saf)
        attended = functional.scaled_dot_product_attention(q[None, None], k[None, None], v[None, None])[0, 0]
        return torch.cat([attended, eaf])

    def modulate(self, means: Tensor, rows: Tensor) -> Tensor:
        """mu' = mu + sigmoid(F') (mu - center) for means [M, 3] that read the rows [M] of F'."""
        gain = torch.sigmoid(self()).index_select(0, rows)
        return torch.addcmul(means, gain, means - self.center)

    @torch.no_grad()
    def unmodulate(self, means: Tensor, rows: Tensor) -> Tensor:
        """The means [M, 3] that `modulate` takes to `means`."""
        gain = torch.sigmoid(self()).index_select(0, rows)
        return self.center + (means - self.center) / (1 + gain)

    @torch.no_grad()
    def _initialise(self, seed: int) -> None:
        """Uniform within 1 / sqrt(inputs), torch's own choice for a linear layer, from the seed alone."""
        generator = torch.Generator().manual_seed(seed)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                bound = 1 / math.sqrt(module.in_features)
                for parameter in module.parameters():
                    parameter.uniform_(-bound, bound, generator=generator)


@torch.no_grad()
def _tokens(views: Sequence[View], count: int) -> tuple[Tensor, Tensor]:
    """The photos I and their maps E as `count` tokens each, [count, 3]; see `ESFG`."""
    runs: tuple[list[Tensor], list[Tensor]] = ([], [])
    for view in views:
        photo, mask = photo_tensors(view)
        edges = edge_magnitude(photo, mask) * floats(photo)  # E = g * I: bright where the photo has edges
        for image, found in zip((floats(photo), edges), runs, strict=True):
            pixels = _downscaled(image, mask)
            if pixels.shape[1]:
                found.append(functional.adaptive_avg_pool1d(pixels, count))
    if not runs[0]:
        raise ValueError(f"the masks of all {len(views)} views are empty, so there is nothing to guide by")
    photo_tokens, edge_tokens = (functional.adaptive_avg_pool1d(torch.cat(r, 1), count).T for r in runs)
    return photo_tokens.contiguous(), edge_tokens.contiguous()


def _downscaled(image: Tensor, mask: Tensor | None) -> Tensor:
    """Counted pixels [3, P] of an image [H, W, 3] after averaging blocks of 2 x 2.

    A block at the border may be smaller. A block's mean is over its counted pixels; blocks without one are
    left out.
    """
    counted = torch.ones(image.shape[:2]) if mask is None else mask.float()
    planes = torch.cat([image.permute(2, 0, 1) * counted, counted[None]])
    means = functional.avg_pool2d(planes, 2, ceil_mode=True).flatten(1)
    means = means[:, means[3] > 0]
    return means[:3] / means[3]


def _linear(inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    """A layer without values, so that torch's global generator is left alone."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, bias=bias)
    assert isinstance(layer, nn.Linear)
    return layer


def edge_magnitude(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Sobel gradient magnitude g [H, W, C] in [0, 1] of an image (HQGS, equation of the edge map).

    sqrt(Ix^2 + Iy^2) for each channel, as the method multiplies it with the image element by element; then
    min-max normalised with one minimum and one maximum for the image. The border is repeated outwards by
    one pixel (kornia's choice), so a constant row or column has no edge at the border. An image without
    edges, such as a constant or a one-pixel one, gives 0 everywhere. No gradient flows through it.

    Args:
        image: [H, W, C], float of any range, or uint8 (divided by 255).
        mask: bool [H, W], True where the photo counts. A pixel whose 3 x 3 neighbours do not all count has
            g = 0 and does not take part in the minimum and the maximum.

    Raises:
        ValueError: a wrong shape or dtype, no pixel, or a value that is not finite.
    """
    from kornia.filters import spatial_gradient  # takes seconds to import

    values = _checked(image, mask)
    ix, iy = spatial_gradient(values.permute(2, 0, 1)[None], mode="sobel", normalized=False)[0].unbind(1)
    magnitude = torch.hypot(ix, iy).permute(1, 2, 0)
    if mask is not None:
        uncounted = functional.max_pool2d((~mask)[None, None].float(), 3, stride=1, padding=1)[0, 0]
        inside = uncounted == 0
        if not inside.any():
            return torch.zeros_like(values)
        counted = magnitude[inside]
    else:
        inside, counted = None, magnitude
    low, high = counted.amin(), counted.amax()
    # Sobel sums of equal numbers differ so much by rounding alone; 8-bit photos have steps of 1/255 at least.
    if high - low <= 1e-5 * values.abs().amax():
        return torch.zeros_like(values)
    # A pixel outside the mask may lie outside the range; it gets 0 below.
    g = (magnitude - low) / (high - low)
    return (g if inside is None else torch.where(inside[..., None], g, 0.0)).contiguous()


def _checked(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image as floats, detached; ValueError where it is none."""
    if image.ndim != 3 or not image.numel():
        raise ValueError(f"image: must be [H, W, C] with at least one pixel, got {list(image.shape)}")
    if image.dtype not in (torch.uint8, torch.float32, torch.float64):
        raise ValueError(f"image: must be uint8, float32 or float64, got {image.dtype}")
    if mask is not None and (mask.dtype != torch.bool or mask.shape != image.shape[:2]):
        wanted = list(image.shape[:2])
        raise ValueError(f"mask: must be bool {wanted} as the image, got {mask.dtype} {list(mask.shape)}")
    values = floats(image.detach())
    if not torch.isfinite(values).all():
        raise ValueError(f"image: {int((~torch.isfinite(values)).sum())} values are not finite")
    return values
