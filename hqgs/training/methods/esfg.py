"""Edge-semantic fusion guidance (ESFG) as the HQGS paper states it: features of the photos move the means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hqgs.base.threads import one_torch_thread
from hqgs.model.gaussians import Gaussians
from hqgs.photos.edges import edge_aware_map
from hqgs.scene.scene import View
from hqgs.training.config import ESFGConfig
from hqgs.training.methods.base import photo_tensors

HIDDEN = 64  # units of the one hidden layer of an MLP; the paper names no size
XYZ = 3  # F' feeds the sigmoid directly, so every feature has one number for each coordinate


class ESFG(nn.Module):
    """The fused feature F' [F, 3] of all training photos, and the positions that it modulates.

    What the paper leaves open is settled so:
    - Fixed size. I and E of each view are area-averaged by `downscale`, then each view's counted pixels, row
      by row, into T runs, then the N T runs of all views into T tokens [T, 3]; T = F / 2 with `concat`, else
      F. This works for any number of views of any sizes. Both steps are averages, so `downscale` changes the
      tokens only a little. The tokens never change, which makes a training step cheap.
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

    def __init__(self, views: Sequence[View], seed: int, config: ESFGConfig) -> None:
        """`views`: all training views. `seed`: of the initial weights.

        Raises ValueError if no pixel of any view counts.
        """
        super().__init__()
        self.config = config
        count = config.feature_size // 2 if config.concat else config.feature_size
        centers = np.mean([view.camera.center for view in views], axis=0)
        self.register_buffer("center", torch.from_numpy(centers).float(), persistent=False)
        with one_torch_thread():
            for name, tokens in zip(("photo", "edge"), _tokens(views, count, config.downscale), strict=True):
                self.register_buffer(f"{name}_tokens", tokens, persistent=False)
        if config.saf:
            self.saf = nn.Sequential(_linear(XYZ, HIDDEN), nn.ReLU(), _linear(HIDDEN, XYZ))
        if config.eaf:
            self.eaf = nn.Sequential(_linear(XYZ, HIDDEN), nn.ReLU(), _linear(HIDDEN, XYZ))
        if config.cross_attention:
            self.query, self.key, self.value = (_linear(XYZ, XYZ, bias=False) for _ in range(3))
        self._initialise(seed)

    def forward(self) -> Tensor:
        """F' [F, 3].

        Both features without `concat` and `cross_attention` are added. With `cross_attention` alone its
        result is F'.
        """
        c = self.config
        if not c.saf:
            return self.eaf(self.edge_tokens)
        saf = self.saf(self.photo_tokens)
        if not c.eaf:
            return saf
        eaf = self.eaf(self.edge_tokens)
        if c.cross_attention:
            q, k, v = self.query(eaf), self.key(saf), self.value(saf)
            saf = functional.scaled_dot_product_attention(q[None, None], k[None, None], v[None, None])[0, 0]
        if c.concat:
            return torch.cat([saf, eaf])
        return saf if c.cross_attention else saf + eaf

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


class FeatureRows:
    """Which row of F' each Gaussian reads.

    The first Gaussians get the rows in turn: F' is replicated as often as needed. From then on the row is a
    Gaussian's for life, however many are pruned before it, and those that are cloned or split from it
    inherit it. (A row chosen by the present position would not do: a Gaussian that crosses into another
    cell, or its child, would jump by a few per cent of the scene.)

    Copies are recognised by their bits. A kept or cloned Gaussian has the position of its parent. The child
    of a split has the rotation and the colour of its parent, which no other one shares once it was trained.
    """

    def __init__(self, feature_size: int) -> None:
        self.feature_size = feature_size
        self.rows: Tensor | None = None  # [M]; None before the first Gaussians
        self._held: tuple[Tensor, ...] = ()  # leaves of the Gaussians of `rows`; the optimizer changes them
        self._marks: tuple[NDArray[np.int64], ...] = ()  # of those of a checkpoint, whose leaves are gone

    def start(self, gaussians: Gaussians) -> Tensor:
        """Rows [M] of the first Gaussians. Call it before they are moved in place."""
        self.rows = torch.arange(len(gaussians)) % self.feature_size
        self._hold(gaussians)
        return self.rows

    def of(self, gaussians: Gaussians) -> Tensor:
        """Rows [M] of these Gaussians, which stem from those of the call before.

        ValueError for Gaussians that stem from none of them.
        """
        if self.rows is None:
            raise ValueError("there are no rows yet: start with the first Gaussians")
        if self._held and gaussians.means is self._held[0]:
            return self.rows
        place, look = self._marks or _fingerprints(*self._held)
        new_place, new_look = _fingerprints(gaussians.means, gaussians.quats, gaussians.sh0)
        parent = _find(place, new_place)
        children = parent < 0
        parent[children] = _find(look, new_look[children])
        if (parent < 0).any():
            raise ValueError(
                f"{int((parent < 0).sum())} of {len(gaussians)} Gaussians are no copies of the "
                f"{len(place)} before them, the first is row {int(np.argmax(parent < 0))}"
            )
        self.rows = self.rows[torch.from_numpy(parent)]
        self._hold(gaussians)
        return self.rows

    def state_dict(self) -> dict[str, Tensor]:
        """The rows [M], and the marks [M] by which the next Gaussians find them. Empty before the start."""
        if self.rows is None:
            return {}
        place, look = self._marks or _fingerprints(*self._held)
        return {"rows": self.rows, "place": torch.from_numpy(place), "look": torch.from_numpy(look)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.rows = state["rows"] if state else None
        self._held = ()
        self._marks = (state["place"].numpy(), state["look"].numpy()) if state else ()

    def _hold(self, gaussians: Gaussians) -> None:
        self._held = (gaussians.means, gaussians.quats, gaussians.sh0)
        self._marks = ()


def _fingerprints(means: Tensor, quats: Tensor, sh0: Tensor) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """64-bit marks [M] of the bits of each position, and of each rotation with its colour."""
    return _hash(means), _hash(torch.cat([quats, sh0.flatten(1)], dim=1))


def _hash(values: Tensor) -> NDArray[np.int64]:
    """Mix the float32 bits of each row into 64: of 10^6 rows two share a mark with a chance of 3e-8."""
    mark = np.zeros(len(values), dtype=np.uint64)
    for column in values.detach().contiguous().numpy().view(np.uint32).T:
        mark = (mark ^ column) * np.uint64(0x9E3779B97F4A7C15)  # odd, so no information is lost
        mark ^= mark >> np.uint64(32)
    return mark.view(np.int64)


def _find(marks: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the first equal mark for each wanted one, -1 where there is none."""
    order = np.argsort(marks, kind="stable")
    at = np.minimum(np.searchsorted(marks, wanted, sorter=order), len(marks) - 1)
    return np.where(marks[order[at]] == wanted, order[at], -1)


@torch.no_grad()
def _tokens(views: Sequence[View], count: int, downscale: int) -> tuple[Tensor, Tensor]:
    """The photos I and their maps E as `count` tokens each, [count, 3]; see `ESFG`."""
    runs: tuple[list[Tensor], list[Tensor]] = ([], [])
    for view in views:
        photo, mask = photo_tensors(view)
        values = photo / 255.0 if photo.dtype == torch.uint8 else photo
        for image, found in zip((values, edge_aware_map(photo, mask)), runs, strict=True):
            pixels = _downscaled(image, mask, downscale)
            if pixels.shape[1]:
                found.append(functional.adaptive_avg_pool1d(pixels, count))
    if not runs[0]:
        raise ValueError(f"the masks of all {len(views)} views are empty, so there is nothing to guide by")
    photo_tokens, edge_tokens = (functional.adaptive_avg_pool1d(torch.cat(r, 1), count).T for r in runs)
    return photo_tokens.contiguous(), edge_tokens.contiguous()


def _downscaled(image: Tensor, mask: Tensor | None, factor: int) -> Tensor:
    """Counted pixels [3, P] of an image [H, W, 3] after averaging blocks of factor x factor.

    A block at the border may be smaller. A block's mean is over its counted pixels; blocks without one are
    left out.
    """
    counted = torch.ones(image.shape[:2]) if mask is None else mask.float()
    planes = torch.cat([image.permute(2, 0, 1) * counted, counted[None]])
    means = functional.avg_pool2d(planes, factor, ceil_mode=True).flatten(1)
    means = means[:, means[3] > 0]
    return means[:3] / means[3]


def _linear(inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    """A layer without values, so that torch's global generator is left alone."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, bias=bias)
    assert isinstance(layer, nn.Linear)
    return layer
