"""What keeps a scene from learning its photos by heart: opacities decay, and Gaussians drop out.

Between few photos much is undetermined: Gaussians that hang in the air, each right in one photo, explain them
as well as surfaces do. Both parts here make what one photo alone holds up fade.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from hqgs.base.elementary import log
from hqgs.model.gaussians import Gaussians

OPAQUE = 0.999  # opacity that dropout raises a Gaussian to, at most: its logit stays finite
DROPPED = -20.0  # logit of a dropped one's opacity, 2e-9: no pixel blends it


@torch.no_grad()
def decay_opacities(logits: Tensor, share: float) -> None:
    """Multiply opacities by 1 - `share`, 0 < share < 1, in place of their `logits` [N].

    Opacity decay of Binocular-Guided 3DGS (Han et al. 2024, arXiv 2410.18822): what the photos
    bear out gains more in a step than it loses, the rest fades until it is culled.
    """
    # logit((1 - d) s(x)) = x + log(1 - d) - log(1 + d e^x); the last term as softplus, which cannot overflow.
    logits += math.log1p(-share) - torch.nn.functional.softplus(logits + math.log(share))


def with_dropout(gaussians: Gaussians, share: float, seed: int, iteration: int) -> Gaussians:
    """The Gaussians of one training step: each is left out with probability `share`, 0 <= share < 1.

    The opacities of the others are divided by 1 - `share`, so that the expected absorption stays
    (DropGaussian, Park et al. 2025, CVPR). Who is left out follows from seed and iteration alone.
    """
    if not share:
        return gaussians
    drawn = np.random.default_rng([seed, iteration]).random(len(gaussians), np.float32)
    opacities = gaussians.activated_opacities() / (1 - share)
    # Decay without end makes 0 of them, whose logarithm has no gradient.
    opacities = opacities.clamp(torch.finfo(opacities.dtype).tiny, OPAQUE)
    kept = log(opacities / (1 - opacities))
    some = torch.where(torch.from_numpy(drawn) < share, DROPPED, kept)
    return gaussians.like(gaussians.named() | {"opacities": some})  # antialiased or not, as they are
