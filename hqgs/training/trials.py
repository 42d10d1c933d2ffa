"""What a scene can do without, tried on photos: Gaussians that no photo shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.model.render import largest_weights
from hqgs.scene.scene import View

TOLERANCE = 0.02  # dB that leaving one thing out may cost
WEIGHTS = (0.1, 0.05, 0.02, 0.01, 0.005)  # limits of the largest blending weight; the first that costs little


@dataclass
class FewerGaussians:
    """A scene with less in it: the PSNR on the photos before, in dB, and what leaving out costs."""

    whole: float
    cost: float
    limit: float  # of the largest blending weight
    faint: Tensor  # bool [N]: those below it

    @property
    def evidence(self) -> str:
        return f"{self.whole:.2f} dB with them, {self.whole - self.cost:.2f} dB without"


def fewest_gaussians(
    shown: Gaussians, views: Sequence[View], psnr: Callable[[Gaussians], float]
) -> FewerGaussians | None:
    """Without those below the highest of WEIGHTS that loses no more than TOLERANCE; None: there are none."""
    weights = largest_weights(shown, views)
    whole = psnr(shown)
    for limit in WEIGHTS:
        faint = weights < limit
        if not 0 < int(faint.sum()) < len(shown):
            continue
        rest = shown.rows(~faint)
        cost = whole - psnr(rest)
        if cost <= TOLERANCE:
            return FewerGaussians(whole, cost, limit, faint)
    return None
