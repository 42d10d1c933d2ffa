"""Covariances as what the rasterizer takes: rotations and scales, and the entries that get the gradient."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.model.formats.turned import quaternions

# Rows and columns of the six entries that count: xx, xy, xz, yy, yz, zz.
UPPER = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def quats_and_scales(covars: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions w x y z [..., N, 4] and standard deviations [..., N, 3] of covariances [..., N, 3, 3].

    As for gsplat, the entries on and above the diagonal count.

    They have no gradient: rotations have none where two scales are equal. Eigenvalues and eigenvectors in
    float64, rounded to the dtype of the covariances; eigenvalues below 0 are 0. Where a covariance is not
    finite, neither are the scales, so that the Gaussian is culled.

    Raises:
        ValueError: another type, dtype or shape than that of the `means`.
    """
    if not isinstance(covars, Tensor):
        raise ValueError(f"covars: expected a torch tensor, got {covars!r:.60}")
    if covars.dtype != means.dtype:
        raise ValueError(f"covars: must have the dtype of means, {means.dtype}, got {covars.dtype}")
    if covars.shape != (*means.shape[:-1], 3, 3):
        wanted = [*means.shape[:-1], 3, 3]
        raise ValueError(f"covars: expected shape {wanted}, got {list(covars.shape)}")
    entries = covars.detach().double()[..., UPPER[0], UPPER[1]]
    finite = entries.isfinite().all(-1, keepdim=True)
    matrices = entries.new_zeros(*entries.shape[:-1], 3, 3)
    matrices[..., UPPER[1], UPPER[0]] = entries.where(finite, 0.0)  # below the diagonal, where eigh looks
    values, axes = torch.linalg.eigh(matrices)
    axes = axes * torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[..., None, None]
    scales = values.clamp(min=0).sqrt().where(finite, torch.nan)
    quats = torch.from_numpy(quaternions(axes.reshape(-1, 3, 3).numpy())).view(*axes.shape[:-2], 4)
    return quats.to(covars.dtype), scales.to(covars.dtype)


def whole(upper: NDArray[np.floating]) -> NDArray[np.floating]:
    """Matrices [N, 3, 3] with these entries [N, 6], and 0 below the diagonal."""
    matrices = np.zeros((len(upper), 3, 3), upper.dtype)
    matrices[:, UPPER[0], UPPER[1]] = upper
    return matrices
