"""The Gaussians as splats of the browser, which sorts and blends them itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.model.constants import SH_C0
from hqgs.model.formats.turned import matrices
from hqgs.model.gaussians import Gaussians

Floats = NDArray[np.float32]


class BrowserSplats(NamedTuple):
    """What `viser` draws, in the order of its arguments."""

    centers: Floats  # [N, 3]
    covariances: Floats  # [N, 3, 3]
    rgbs: Floats  # [N, 3], 0 to 1
    opacities: Floats  # [N, 1]


def browser_splats(gaussians: Gaussians) -> BrowserSplats:
    """The Gaussians as the browser draws them.

    Colours are those of the constant harmonic alone: the same from every side. Gaussians with a value
    that is not finite are left out.
    """
    rows = torch.cat([tensor.detach().flatten(1) for tensor in _columns(gaussians)], dim=1)
    g = gaussians.detached().rows(rows.isfinite().all(1))
    factors = matrices(g.quats.double().numpy()) * g.activated_scales()[:, None].numpy()
    colors = (0.5 + SH_C0 * g.sh0[:, 0]).clamp(0, 1)
    found = g.means, factors @ factors.swapaxes(1, 2), colors, g.activated_opacities()[:, None]
    return BrowserSplats(*(np.asarray(values, np.float32) for values in found))


def _columns(g: Gaussians) -> list[torch.Tensor]:
    return [g.means, g.scales, g.quats, g.opacities[:, None], g.sh0]
