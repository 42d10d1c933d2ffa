"""Veils: Gaussians so large, or so near, that a camera stands within them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.training.densify import quats_to_matrices

WITHIN = 3.0  # standard deviations from a camera to a Gaussian's mean: it hangs before the picture then


@torch.no_grad()
def veils(gaussians: Gaussians, centers: NDArray[np.float64]) -> Tensor:
    """Which Gaussians hold one of the cameras at `centers` [C, 3], bool [N].

    A part may have such ones for its own photos, which other photos see nothing but.
    """
    found = torch.zeros(len(gaussians), dtype=torch.bool)
    means, scales = gaussians.means.double(), gaussians.activated_scales().double()
    nearest = torch.from_numpy(KDTree(centers).query(means.numpy())[0])
    rows = torch.nonzero(nearest <= WITHIN * scales.amax(1))[:, 0]
    turned = quats_to_matrices(gaussians.quats[rows].double())
    for center in torch.from_numpy(centers):
        away = torch.einsum("nji,nj->ni", turned, center - means[rows]) / scales[rows]
        found[rows] |= away.norm(dim=1) < WITHIN
    return found
