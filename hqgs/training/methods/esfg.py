"""Edge-semantic fusion guidance (ESFG) as the HQGS paper states it: features of the photos move the means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hqgs.base.threads import one_torch_thread
from hqgs.photos.edges import edge_aware_map
from hqgs.photos.pixels import floats
from hqgs.scene.scene import View
from hqgs.training.methods.base import photo_tensors

HIDDEN = 64  # units of the one hidden layer of an MLP; the paper names no size
FEATURES = 1000  # F, the rows of F'
XYZ = 3  # F' feeds the sigmoid directly, so every feature has one number for each coordinate


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
        for image, found in zip((floats(photo), edge_aware_map(photo, mask)), runs, strict=True):
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
