"""The mean of a scene over the last steps of its run: what is shown and written at the end.

Each step serves one photo, and moves the scene a little away from the others; the mean over many steps
serves them all (Polyak and Juditsky 1992, SIAM J. Control Optim. 30(4)). Training goes on from the scene
itself: the mean changes no step.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from hqgs.model.gaussians import Gaussians


@dataclass
class Average:
    """Of the Gaussians after some steps, in between which no row came or went."""

    count: int = 0  # steps
    means: dict[str, Tensor] = field(default_factory=dict)  # of each tensor of the Gaussians, by its name

    @torch.no_grad()
    def add(self, gaussians: Gaussians) -> None:
        """Count them in as they are after a step."""
        self.count += 1
        for name, tensor in gaussians.named().items():
            if self.count == 1:
                self.means[name] = tensor.detach().clone()
            else:
                self.means[name].lerp_(tensor, 1 / self.count)

    def clear(self) -> None:
        """Forget all steps."""
        self.count, self.means = 0, {}

    def of(self, gaussians: Gaussians) -> Gaussians:
        """The mean, or `gaussians` themselves where no step has been counted in."""
        return gaussians.like(self.means) if self.count else gaussians
