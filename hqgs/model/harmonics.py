"""Spherical harmonics in torch, and how to do with fewer bands of them."""

from __future__ import annotations

import torch
from torch import Tensor

from hqgs.model.constants import SH_C0
from hqgs.model.gaussians import Gaussians
from hqgs.scene.geometry import in_picture
from hqgs.scene.scene import View

RIDGE = 1e-2  # weight of the old coefficients beside the mean over the views
CHUNK = 16_384  # Gaussians at a time: bounds the memory to some 100 MB


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """The real harmonics up to this degree (0..3) at unit directions [..., 3], [..., (degree + 1)^2].

    Order and signs are those of 3DGS (docs/conventions.md).
    """
    x, y, z = directions.unbind(-1)
    rows = [torch.full_like(x, SH_C0)]
    if degree > 0:
        rows += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        rows += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 2:
        rows += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(rows, dim=-1)


@torch.no_grad()
def folded(gaussians: Gaussians, views: list[View], degree: int) -> Gaussians:
    """The Gaussians with harmonics up to this degree only, which look as before from the views.

    Seen from a few sides, the higher bands of a Gaussian are hardly told from the lower ones: dropping them
    alone would change its colour. The lower coefficients are those that come nearest, in least squares, to
    the old colours in the views that have the Gaussian in their picture; RIDGE holds what no view tells.
    """
    kept = (degree + 1) ** 2
    old = torch.cat([gaussians.sh0, gaussians.shN], dim=1).detach().double()  # [N, K, 3]
    new = torch.empty(len(gaussians), kept, 3, dtype=torch.float64)
    for start in range(0, len(gaussians), CHUNK):
        rows = slice(start, start + CHUNK)
        means = gaussians.means[rows].detach().double()
        squares = torch.zeros(len(means), kept, kept, dtype=torch.float64)
        right = torch.zeros(len(means), kept, 3, dtype=torch.float64)
        count = torch.zeros(len(means), dtype=torch.float64)
        for view in views:
            _, seen = in_picture(means, view.camera)
            offset = means - torch.from_numpy(view.camera.center)
            basis = sh_basis(torch.nn.functional.normalize(offset, dim=1), gaussians.sh_degree)
            basis = basis * seen[:, None]
            low, high = basis[:, :kept], basis[:, kept:]
            squares += low[:, :, None] * low[:, None, :]
            right += low[:, :, None] * (high[:, :, None] * old[rows, kept:]).sum(1)[:, None, :]
            count += seen
        # What the higher bands gave, in the mean over the views, goes to the lower ones.
        scale = count.clamp(min=1)[:, None, None]
        eye = RIDGE * torch.eye(kept, dtype=torch.float64)
        new[rows] = old[rows, :kept] + torch.linalg.solve(squares / scale + eye, right / scale)
    new = new.to(gaussians.sh0.dtype)
    colors = {"sh0": new[:, :1].clone(), "shN": new[:, 1:].clone()}
    return Gaussians(**(gaussians.detached().named() | colors))
