"""What a scene can do without, tried on photos: bands of its harmonics, and Gaussians that no photo shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.model.harmonics import folded
from hqgs.model.render import largest_weights
from hqgs.scene.scene import View
from hqgs.training.schedule import spread

TOLERANCE = 0.02  # dB that leaving one thing out may cost
WEIGHTS = (0.1, 0.05, 0.02, 0.01, 0.005)  # limits of the largest blending weight; the first that costs little
FOLDED = 16  # views, at most, from which the folded bands are to look as before


@dataclass
class Fewer:
    """A scene with less in it: the PSNR on the photos before, in dB, and what leaving out costs."""

    whole: float
    cost: float

    @property
    def evidence(self) -> str:
        return f"{self.whole:.2f} dB with them, {self.whole - self.cost:.2f} dB without"


@dataclass
class FewerBands(Fewer):
    degree: int
    colors: dict[str, Tensor]  # sh0 and shN, folded into those bands


@dataclass
class FewerGaussians(Fewer):
    limit: float  # of the largest blending weight
    faint: Tensor  # bool [N]: those below it


def fewest_bands(
    gaussians: Gaussians, shown: Gaussians, views: Sequence[View], psnr: Callable[[Gaussians], float]
) -> FewerBands | None:
    """The fewest bands that lose no more than TOLERANCE against all of them; None: all are needed.

    `shown` is what is rasterized of `gaussians`, which `views` show; `psnr` judges it, in dB.
    """
    whole = psnr(shown)
    some = spread(views, FOLDED)
    for degree in range(gaussians.sh_degree):
        fewer = folded(gaussians, some, degree)
        colors = {"sh0": fewer.sh0, "shN": fewer.shN}
        cost = whole - psnr(Gaussians(**(shown.named() | colors)))
        if cost <= TOLERANCE:
            return FewerBands(whole, cost, degree, colors)
    return None


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
