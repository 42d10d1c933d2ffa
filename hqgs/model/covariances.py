"""Covariances as what the rasterizer takes: rotations and scales, and the entries that get the gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from hqgs.model.formats.turned import quaternions

# Rows and columns of the six entries that count: xx, xy, xz, yy, yz, zz.
UPPER = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]


def upper_entries(covars: Tensor, means: Tensor) -> Tensor:
    """The entries on and above the diagonal [..., N, 6] of covariances [..., N, 3, 3], as gsplat takes them.

    Raises:
        ValueError: another type, dtype or shape.
    """
    if not isinstance(covars, Tensor):
        raise ValueError(f"covars: expected a torch tensor, got {covars!r:.60}")
    if covars.dtype != means.dtype:
        raise ValueError(f"covars: must have the dtype of means, {means.dtype}, got {covars.dtype}")
    if covars.shape != (*means.shape[:-1], 3, 3):
        wanted = [*means.shape[:-1], 3, 3]
        raise ValueError(f"covars: expected shape {wanted}, got {list(covars.shape)}")
    return covars[..., UPPER[0], UPPER[1]]


def quats_and_scales(upper: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions w x y z [..., N, 4] and standard deviations [..., N, 3] of covariances by `upper_entries`.

    They have no gradient: rotations have none where two scales are equal. Eigenvalues and eigenvectors in
    float64, rounded to the dtype of the covariances; eigenvalues below 0 are 0. Where a covariance is not
    finite, neither are the scales, so that the Gaussian is culled.
    """
    entries = upper.detach().double()
    finite = entries.isfinite().all(-1, keepdim=True)
    matrices = entries.new_zeros(*entries.shape[:-1], 3, 3)
    matrices[..., UPPER[1], UPPER[0]] = entries.where(finite, 0.0)  # below the diagonal, where eigh looks
    values, axes = torch.linalg.eigh(matrices)
    axes = axes * torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[..., None, None]
    scales = values.clamp(min=0).sqrt().where(finite, torch.nan)
    quats = torch.from_numpy(quaternions(axes.reshape(-1, 3, 3).numpy())).view(*axes.shape[:-2], 4)
    return quats.to(upper.dtype), scales.to(upper.dtype)
