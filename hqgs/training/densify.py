"""Adaptive density control of 3DGS: grow where the image gradient is high, prune what is transparent or huge.

Kerbl et al. 2023, section 5.2. Every change of the number of Gaussians is a selection of rows, done by
`select_rows` on the parameters and on the optimizer's state alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer

from hqgs import _rust
from hqgs.base.elementary import exp
from hqgs.model.gaussians import Gaussians
from hqgs.training.adam import select_rows
from hqgs.training.config import DensifyConfig

SPLIT_CHILDREN = 2  # of a Gaussian that is split (Kerbl et al. 2023, section 5.2)


@dataclass(frozen=True)
class Densification:
    """What one call of `Densifier.update` did."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0
    refused: int = 0  # Gaussians that would have grown but are too fine
    # [M]: the former rows that those of now stem from; None: no row has changed.
    parents: Tensor | None = field(default=None, compare=False)


class Densifier:
    """Gathers image gradients and changes the set of Gaussians, when the schedule asks for it.

    The random numbers of a round follow from (seed, iteration) alone, so there is no generator to save.
    """

    def __init__(
        self, config: DensifyConfig, extent: float, reach: float, seed: int, num_gaussians: int
    ) -> None:
        """`extent`, `reach`: the scene's, world units. `num_gaussians`: N at the start."""
        self.config = config
        self.extent = extent
        self.reach = reach
        self.seed = seed
        self.grad_sum: Tensor = torch.zeros(num_gaussians)  # of gradient norms, half images
        self.count: Tensor = torch.zeros(num_gaussians)  # views in which the Gaussian was visible

    def observe(self, means2d_grad: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Add one view: `means2d_grad` [N, 2] in loss per pixel, `radii` [N, 2] (0: not visible)."""
        sums, views = self.grad_sum.numpy(), self.count.numpy()
        gradient, seen = means2d_grad.float().contiguous().numpy(), radii.contiguous().numpy()
        _rust.add_pulls(sums, views, gradient, seen, (width / 2, height / 2))

    def note(self, rows: Tensor, norms: Tensor) -> None:
        """Add one view that shows these rows, [M], whose gradients have these norms, half images."""
        self.grad_sum[rows] += norms
        self.count[rows] += 1

    def update(
        self, iteration: int, gaussians: Gaussians, optimizer: Optimizer, finest: Tensor | None = None
    ) -> Densification:
        """One round of densification after this iteration (1, 2, ...).

        `gaussians` and `optimizer` get new tensors in place of the old ones. `finest` [N], world units:
        Gaussians whose largest scale is at most that are too fine to be cloned or split.
        """
        densified = self._clone_and_split(iteration, gaussians, optimizer, finest)
        densified = self._prune(iteration, gaussians, optimizer, densified)
        self.grad_sum = torch.zeros(len(gaussians))
        self.count = torch.zeros(len(gaussians))
        return densified

    def remove(self, bad: Tensor, gaussians: Gaussians, optimizer: Optimizer) -> Tensor:
        """Remove the Gaussians where `bad`, bool [N], out of turn; the statistics of the others stay.

        Returns the rows that are left, [M].
        """
        kept = torch.nonzero(~bad)[:, 0]
        select_rows(gaussians, optimizer, kept, old=len(kept))
        self.grad_sum, self.count = self.grad_sum[kept], self.count[kept]
        return kept

    def _clone_and_split(
        self, iteration: int, gaussians: Gaussians, optimizer: Optimizer, finest: Tensor | None
    ) -> Densification:
        """Clone the small and split the large among those with a high mean gradient."""
        n = len(gaussians)
        grad = self.grad_sum / self.count.clamp(min=1)
        refused = 0
        if finest is not None:
            fine = _largest_scale(gaussians) <= finest
            refused = int((fine & (grad >= self.config.grad_threshold)).sum())
            grad = torch.where(fine, -1.0, grad)
        # Either way a candidate adds one Gaussian to the total.
        order = torch.argsort(grad, descending=True, stable=True)[: self.config.max_gaussians - n]
        grow = torch.zeros(n, dtype=torch.bool)
        grow[order] = grad[order] >= self.config.grad_threshold
        large = _largest_scale(gaussians) > self.config.percent_dense * self.extent
        kept = torch.nonzero(~(grow & large))[:, 0]
        cloned = torch.nonzero(grow & ~large)[:, 0]
        split = torch.nonzero(grow & large)[:, 0]

        parents = torch.cat([kept, cloned, *[split] * SPLIT_CHILDREN])
        select_rows(gaussians, optimizer, parents, old=len(kept))
        children = slice(len(kept) + len(cloned), len(gaussians))
        rng = np.random.default_rng([self.seed, iteration])
        with torch.no_grad():
            scales = gaussians.activated_scales()[children]
            normal = torch.from_numpy(rng.standard_normal(tuple(scales.shape), dtype=np.float32))
            rotation = quats_to_matrices(gaussians.quats[children])
            gaussians.means[children] += (rotation @ (scales * normal)[:, :, None])[:, :, 0]
            gaussians.scales[children] -= math.log(0.8 * SPLIT_CHILDREN)
        grown = len(cloned) or len(split)
        return Densification(len(cloned), len(split), 0, refused, parents if grown else None)

    def _prune(
        self, iteration: int, gaussians: Gaussians, optimizer: Optimizer, densified: Densification
    ) -> Densification:
        with torch.no_grad():
            bad = gaussians.activated_opacities() < self.config.prune_opacity
            if iteration > self.config.reset_every:
                bad |= _largest_scale(gaussians) > self.config.prune_scale * self.reach
        pruned = int(bad.sum())
        if not pruned:
            return densified
        kept = torch.nonzero(~bad)[:, 0]
        select_rows(gaussians, optimizer, kept, old=len(kept))
        parents = kept if densified.parents is None else densified.parents[kept]
        return replace(densified, pruned=pruned, parents=parents)


def quats_to_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4], w x y z, any non-zero norm."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(dim=1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
        ],
        dim=1,
    )


def _largest_scale(gaussians: Gaussians) -> Tensor:
    return exp(gaussians.scales.detach().amax(dim=1))
