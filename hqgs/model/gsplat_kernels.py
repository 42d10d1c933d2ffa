"""What gsplat's strategies ask of its CUDA kernels, for a machine that has none."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor


def gsplat_on_cpu() -> None:
    """Let `gsplat.MCMCStrategy` run on the CPU; `gsplat.DefaultStrategy` does without.

    Two kernels are put where the installed gsplat looks for its own: `relocation`, and
    `quat_scale_to_covar_preci_fwd`, of which it has a version for PyTorch. Nothing is changed where it has
    its kernels. ImportError without gsplat.
    """
    from gsplat.cuda import _backend, _torch_impl

    if _backend._C is None:
        _backend._C = SimpleNamespace(  # pyright: ignore[reportAttributeAccessIssue]
            relocation=relocation, quat_scale_to_covar_preci_fwd=_torch_impl._quat_scale_to_covar_preci
        )


def relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, n_max: int
) -> tuple[Tensor, Tensor]:
    """Opacities [M] and scales [M, 3] of Gaussians of which `ratios` [M], 1..n_max, shall stand for one.

    3DGS-MCMC (Kheradmand et al. 2024, equation 9): along a line through the middle, together they have the
    alpha of the one that was. `binoms` [n_max, n_max] holds the binomials (n over k). Computed in float64:
    the sum alternates.
    """
    before, counts = opacities.double(), ratios.long()
    now = 1 - (1 - before) ** (1 / counts)
    k = torch.arange(n_max, dtype=torch.float64)
    over = binoms.double().cumsum(0)[counts - 1]  # (1 over k) + ... + (n - 1 over k) = (n over k + 1)
    along = (over * (-1) ** k / (k + 1).sqrt() * now[:, None] ** (k + 1)).sum(1)
    return now.to(opacities.dtype), ((before / along)[:, None] * scales).to(scales.dtype)
