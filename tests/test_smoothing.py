"""The smallest Gaussian that photos show: its size, and the gradient of the trained size."""

from __future__ import annotations

import numpy as np
import torch
from tiny_scene import tiny_scene

from hqgs.model.gaussians import Gaussians
from hqgs.model.shapes import enlarge


def test_variances_add_and_the_gradient_is_that_of_the_sum() -> None:
    scene = tiny_scene()
    gaussians = Gaussians.from_points(scene.points, scene.point_colors)
    n, generator = len(gaussians), torch.Generator().manual_seed(0)
    smallest = torch.rand(n, generator=generator).double()
    scales = torch.randn(n, 3, generator=generator).double().requires_grad_()
    gaussians.scales = scales
    found = enlarge(gaussians, smallest)
    variances = np.exp(2 * scales.detach().numpy()) + np.square(smallest.numpy())[:, None]
    np.testing.assert_allclose(found.scales.detach().exp().square(), variances, rtol=1e-12)
    assert found.opacities is gaussians.opacities
    # d log sqrt(e^(2 s) + m^2) / ds by differences.
    weights = torch.randn(n, 3, generator=generator).double()
    (found.scales * weights).sum().backward()
    step = 1e-6
    sides = [
        0.5 * np.log(np.exp(2 * (scales.detach().numpy() + h)) + np.square(smallest.numpy())[:, None])
        for h in (step, -step)
    ]
    assert scales.grad is not None
    expected = weights.numpy() * (sides[0] - sides[1]) / (2 * step)
    np.testing.assert_allclose(scales.grad, expected, rtol=1e-6, atol=1e-9)
