"""Gaussians start as their neighbours lie."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hqgs.model.constants import THINNEST
from hqgs.model.gaussians import Gaussians
from hqgs.model.shapes import as_discs
from tests.reference import rotation_matrices


def started(points: np.ndarray) -> tuple[Gaussians, Gaussians]:
    """The Gaussians of a cloud as 3DGS starts, and as discs."""
    made = Gaussians.from_points(points.astype(np.float32), np.full((len(points), 3), 99, np.uint8), 1)
    return made, as_discs(made)


def axes(gaussians: Gaussians) -> torch.Tensor:
    """[N, 3, 3], the axes as columns."""
    return rotation_matrices(gaussians.quats.double())


def test_points_of_a_plane_become_discs_in_it() -> None:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    round_ones, discs = started((flat + rng.uniform(-0.2, 0.2, flat.shape) * [1, 1, 0]) @ turn.T)
    normals = axes(discs)[:, :, 2]
    torch.testing.assert_close((normals @ torch.from_numpy(turn[:, 2])).abs(), torch.ones(400).double())
    shape = (discs.scales - round_ones.scales).exp()
    torch.testing.assert_close(shape[:, 0] * shape[:, 1], torch.ones(400), rtol=1e-5, atol=0)
    torch.testing.assert_close(shape[:, 2] / shape[:, 0], torch.full((400,), THINNEST[2]), rtol=1e-5, atol=0)
    for name in ("means", "opacities", "sh0", "shN"):
        assert getattr(discs, name) is getattr(round_ones, name)


def test_points_of_a_line_become_needles_along_it() -> None:
    along = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    _, needles = started(np.linspace(0, 9, 50)[:, None] * along)
    turned = (axes(needles)[:, :, 0] @ torch.from_numpy(along)).abs()
    torch.testing.assert_close(turned, torch.ones(50).double())
    thinner = (needles.scales[:, 1:] - needles.scales[:, :1]).exp()
    torch.testing.assert_close(thinner, torch.tensor(THINNEST[1:]).expand(50, 2), rtol=1e-5, atol=0)


@pytest.mark.parametrize("count", [4, 5, 300])
def test_any_cloud_gives_finite_gaussians_of_unit_quaternions(count: int) -> None:
    points = np.random.default_rng(1).normal(size=(count, 3))
    for cloud in (points, np.ones((count, 3)), points * [1e6, 1e-6, 1]):
        _, discs = started(cloud)
        assert all(torch.isfinite(tensor).all() for tensor in discs.named().values())
        assert all(tensor.is_contiguous() for tensor in discs.named().values())
        torch.testing.assert_close(discs.quats.norm(dim=1), torch.ones(count))
        torch.testing.assert_close(torch.linalg.det(axes(discs)), torch.ones(count).double())
