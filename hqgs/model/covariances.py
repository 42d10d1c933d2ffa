"""Covariances as the rotations and scales that the rasterizer takes."""

from __future__ import annotations

import torch
from torch import Tensor


def quats_and_scales(covars: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions w x y z [..., N, 4] and standard deviations [..., N, 3] of covariances [..., N, 3, 3].

    Eigenvalues and eigenvectors in float64, rounded to the dtype of the covariances. Of a matrix that is not
    symmetric the symmetric part counts; eigenvalues below 0 are 0. Where a matrix is not finite, neither are
    the scales, so that the Gaussian is culled.

    Raises:
        ValueError: another type, dtype or shape.
        NotImplementedError: covariances that require a gradient. Rotations have none where two scales are
            equal, so what is trained must be quats and scales.
    """
    if not isinstance(covars, Tensor):
        raise ValueError(f"covars: expected a torch tensor, got {covars!r:.60}")
    if covars.dtype != means.dtype:
        raise ValueError(f"covars: must have the dtype of means, {means.dtype}, got {covars.dtype}")
    if covars.shape != (*means.shape[:-1], 3, 3):
        wanted = [*means.shape[:-1], 3, 3]
        raise ValueError(f"covars: expected shape {wanted}, got {list(covars.shape)}")
    if covars.requires_grad:
        raise NotImplementedError("covars: no gradient with respect to covariances; train quats and scales")
    matrices = covars.double()
    finite = matrices.isfinite().flatten(-2).all(-1)
    matrices = torch.where(finite[..., None, None], matrices, torch.eye(3, dtype=torch.float64))
    values, axes = torch.linalg.eigh(0.5 * (matrices + matrices.mT))
    axes = axes * torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[..., None, None]
    scales = torch.where(finite[..., None], values.clamp(min=0).sqrt(), torch.nan)
    return _quaternions(axes).to(means.dtype), scales.to(means.dtype)


def _quaternions(R: Tensor) -> Tensor:
    """Of rotations [..., 3, 3]: the largest component from the diagonal, the others over it."""
    x, y, z = R.diagonal(dim1=-2, dim2=-1).unbind(-1)
    squares = 1 + torch.stack([x + y + z, x - y - z, y - x - z, z - x - y], -1)  # 4 w^2, ...
    a, b, c = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    d, e, f = R[..., 1, 0] + R[..., 0, 1], R[..., 0, 2] + R[..., 2, 0], R[..., 2, 1] + R[..., 1, 2]
    w, i, j, k = squares.unbind(-1)
    rows = torch.stack(  # each times 4 w, 4 x, 4 y or 4 z
        [
            torch.stack([w, a, b, c], -1),
            torch.stack([a, i, d, e], -1),
            torch.stack([b, d, j, f], -1),
            torch.stack([c, e, f, k], -1),
        ],
        -2,
    )
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    return torch.nn.functional.normalize(rows.gather(-2, largest).squeeze(-2), dim=-1)
