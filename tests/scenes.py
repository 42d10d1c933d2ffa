"""Seeded scenes for the tests of the rasterizer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class GaussianScene:
    """Gaussians and cameras; the names are the arguments of `rasterization`."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, D], [C, N, D], [N, K, 3] or [C, N, K, 3]
    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    backgrounds: Tensor  # [C, D]
    width: int
    height: int
    sh_degree: int | None

    def tensors(self) -> dict[str, Tensor]:
        """The tensor arguments, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def arguments(self, **changes: Any) -> dict[str, Any]:
        """All arguments by name, for `rasterization(**scene.arguments())`, with `changes` put in."""
        return {"packed": False, **vars(self), **changes}

    def with_grad(self, *names: str) -> GaussianScene:
        """A copy whose tensors are new leaves; those named require a gradient."""
        leaves = {k: v.detach().clone().requires_grad_(k in names) for k, v in self.tensors().items()}
        return replace(self, **leaves)

    def to(self, dtype: torch.dtype) -> GaussianScene:
        """A copy with all tensors cast."""
        return replace(self, **{k: v.to(dtype) for k, v in self.tensors().items()})

    def pick(self, ids: Tensor) -> GaussianScene:
        """A copy with the Gaussians `ids`, in that order."""
        dim = self.colors.dim() - (2 if self.sh_degree is None else 3)  # 0, or 1 for per-camera colors
        kept = {name: getattr(self, name)[ids] for name in ("means", "quats", "scales", "opacities")}
        return replace(self, colors=self.colors.index_select(dim, ids), **kept)


def _look(rng: np.random.Generator, camera: int, distance: float) -> NDArray[np.float64]:
    """World to camera [4, 4]; camera 0 is arbitrary, the others turn around the point in front of it."""
    angles = rng.uniform(-0.35, 0.35, 3) if camera else rng.uniform(-2.0, 2.0, 3)
    R = np.eye(3)
    for axis, angle in enumerate(angles):
        i, j = [k for k in range(3) if k != axis]
        turn = np.eye(3)
        turn[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        R = turn @ R
    viewmat = np.eye(4)
    viewmat[:3, :3] = R
    pivot = np.array([0.0, 0.0, distance])
    viewmat[:3, 3] = pivot - R @ pivot if camera else rng.normal(0.0, 2.0, 3)
    return viewmat


def random_scene(
    n: int,
    width: int,
    height: int,
    cameras: int = 1,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
    sh_degree: int | None = None,
    channels: int = 3,
    per_camera_colors: bool = False,
    anisotropy: float = 100.0,
    largest: float = 0.5,
    hidden: float = 0.1,
    opacity: tuple[float, float] = (0.02, 0.999),
) -> GaussianScene:
    """A mixture meant to reach every branch.

    Standard deviations on the screen run from 0.1 px to `largest` times the width, most of them small; axis
    ratios reach `anisotropy`; opacities lie in `opacity`, denser near its end (a tenth above the cap).
    A share `hidden` of the Gaussians lies behind the camera, and about a quarter of the rest off the screen.
    Quaternions are not normalised, the principal point is off-centre, fx != fy. With `sh_degree`, `colors`
    holds one degree of coefficients more than is active (up to 3).
    """
    rng = np.random.default_rng(seed)
    distance = 4.0
    first = _look(rng, 0, distance)
    viewmats = np.stack([first] + [_look(rng, c, distance) @ first for c in range(1, cameras)])
    Ks = np.zeros((cameras, 3, 3))
    Ks[:, 0, 0] = width * rng.uniform(0.8, 1.3, cameras)
    Ks[:, 1, 1] = Ks[:, 0, 0] * rng.uniform(0.85, 1.15, cameras)
    Ks[:, 0, 2] = width * rng.uniform(0.4, 0.6, cameras)
    Ks[:, 1, 2] = height * rng.uniform(0.4, 0.6, cameras)
    Ks[:, 2, 2] = 1.0

    depth = rng.uniform(1.0, 8.0, n)
    u = width * rng.uniform(-0.1, 1.1, n)
    v = height * rng.uniform(-0.1, 1.1, n)
    x, y = (u - Ks[0, 0, 2]) / Ks[0, 0, 0], (v - Ks[0, 1, 2]) / Ks[0, 1, 1]
    in_camera = np.stack([x, y, np.ones(n)], axis=1)
    depth = np.where(rng.random(n) < hidden, -depth, depth)
    means = (in_camera * depth[:, None] - first[:3, 3]) @ first[:3, :3]

    low, high = np.log(0.1), np.log(largest * width)
    size = np.exp(low + (high - low) * rng.random(n) ** 1.5)  # pixels
    ratios = anisotropy ** -(rng.random((n, 3)) ** 2)
    scales = (size * np.abs(depth) / Ks[0, 0, 0])[:, None] * ratios
    quats = rng.normal(size=(n, 4)) * np.exp(rng.uniform(-2.0, 2.0, (n, 1)))

    lead = (cameras, n) if per_camera_colors else (n,)
    if sh_degree is None:
        colors = rng.random((*lead, channels))
    else:
        channels = 3
        bands = (min(sh_degree + 1, 3) + 1) ** 2
        colors = rng.normal(0.0, 0.25, (*lead, bands, 3))
        colors[..., 0, :] += rng.normal(0.0, 1.0, (*lead, 3))
    return GaussianScene(
        means=torch.tensor(means, dtype=dtype),
        quats=torch.tensor(quats, dtype=dtype),
        scales=torch.tensor(scales, dtype=dtype),
        opacities=torch.tensor(opacity[1] - (opacity[1] - opacity[0]) * rng.random(n) ** 2, dtype=dtype),
        colors=torch.tensor(colors, dtype=dtype),
        viewmats=torch.tensor(viewmats, dtype=dtype),
        Ks=torch.tensor(Ks, dtype=dtype),
        backgrounds=torch.tensor(rng.random((cameras, channels)), dtype=dtype),
        width=width,
        height=height,
        sh_degree=sh_degree,
    )
