"""Harmonics in torch against the independent reference, and folding of bands."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_scene import tiny_scene

from hqgs.model.gaussians import Gaussians
from hqgs.model.harmonics import folded, sh_basis
from hqgs.model.render import render_view


def random_gaussians(seed: int = 0) -> Gaussians:
    scene = tiny_scene(num_points=60)
    gaussians = Gaussians.from_points(scene.points, scene.point_colors)
    rng = np.random.default_rng(seed)
    gaussians.opacities.fill_(3.0)
    gaussians.shN.copy_(torch.from_numpy(rng.normal(0, 0.1, gaussians.shN.shape)))
    return gaussians


def test_the_basis_is_orthonormal() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * 2 * np.pi / 16
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, angles, indexing="ij"))
    r = np.sqrt(1 - z**2)
    directions = torch.from_numpy(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1))
    basis = sh_basis(directions, 3)
    products = basis.T @ (basis * torch.from_numpy(np.repeat(weights, 16) * 2 * np.pi / 16)[:, None])
    torch.testing.assert_close(products, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis_is_that_of_the_rasterizer(degree: int) -> None:
    gaussians = random_gaussians()
    view = tiny_scene().train[0]
    directions = gaussians.means - torch.from_numpy(view.camera.center).float()
    basis = sh_basis(torch.nn.functional.normalize(directions, dim=1), degree)
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], dim=1)[:, : (degree + 1) ** 2]
    colors = (basis[:, :, None] * coefficients).sum(1)  # what degree 0 must hold to look the same here
    flat = Gaussians(**(gaussians.named() | {"sh0": colors[:, None] / 0.28209479177387814}))
    want, _ = render_view(flat, view.camera, 0, (0.0, 0.0, 0.0))
    got, _ = render_view(gaussians, view.camera, degree, (0.0, 0.0, 0.0))
    torch.testing.assert_close(got, want, rtol=0, atol=2e-6)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_folded_bands_look_as_before_from_the_views(degree: int) -> None:
    gaussians, views = random_gaussians(), tiny_scene(13).train
    fewer = folded(gaussians, views, degree)
    assert fewer.sh_degree == degree
    cut = Gaussians(**(gaussians.named() | {"shN": gaussians.shN[:, : (degree + 1) ** 2 - 1]}))

    def error(other: Gaussians) -> float:
        squares = []
        for view in views:
            want, _ = render_view(gaussians, view.camera, 3, (0.0, 0.0, 0.0))
            got, _ = render_view(other, view.camera, degree, (0.0, 0.0, 0.0))
            squares.append(float((got - want).square().mean()))
        return float(np.sqrt(np.mean(squares)))

    assert error(fewer) < 0.2 * error(cut)


def test_folding_nothing_changes_nothing() -> None:
    gaussians = random_gaussians()
    gaussians.shN[:, 3:] = 0
    fewer = folded(gaussians, tiny_scene().train, 1)
    torch.testing.assert_close(fewer.sh0, gaussians.sh0, rtol=0, atol=1e-7)
    torch.testing.assert_close(fewer.shN, gaussians.shN[:, :3], rtol=0, atol=1e-7)


def test_gaussians_that_no_view_sees_keep_their_coefficients() -> None:
    gaussians = random_gaussians()
    gaussians.means[:, 2] = -5.0
    fewer = folded(gaussians, tiny_scene().train, 1)
    torch.testing.assert_close(fewer.sh0, gaussians.sh0, rtol=0, atol=1e-7)
