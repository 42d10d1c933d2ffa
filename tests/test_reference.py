"""The reference renderer against closed forms and computations that share nothing with it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from reference import reference_rasterization, rotation_matrices, sh_basis, sh_colors
from scenes import GaussianScene, random_scene

F64 = torch.float64
TWO = [[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]]  # index 1 is in front
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def frontal(
    means: list[list[float]], opacities: list[float], colors: list[list[float]], scale: float = 0.2
) -> GaussianScene:
    """Isotropic Gaussians before a camera at the origin: 9 x 7 pixels, f = 10, axis through pixel (3, 4)."""
    n = len(means)
    return GaussianScene(
        means=torch.tensor(means, dtype=F64),
        quats=torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=F64).repeat(n, 1),
        scales=torch.full((n, 3), scale, dtype=F64),
        opacities=torch.tensor(opacities, dtype=F64),
        colors=torch.tensor(colors, dtype=F64),
        viewmats=torch.eye(4, dtype=F64)[None],
        Ks=torch.tensor([[[10.0, 0.0, 4.5], [0.0, 10.0, 3.5], [0.0, 0.0, 1.0]]], dtype=F64),
        backgrounds=torch.tensor([[0.25, 0.5, 0.75]], dtype=F64),
        width=9,
        height=7,
        sh_degree=None,
    )


def test_one_isotropic_gaussian_by_hand() -> None:
    """On the axis the screen variance is (f s / z)^2 + 0.3, and nothing is skewed."""
    scene = frontal([[0.0, 0.0, 2.0]], [0.8], [[0.9, 0.1, 0.4]])
    render, alphas, meta = reference_rasterization(**scene.arguments())
    variance = (10.0 * 0.2 / 2.0) ** 2 + 0.3
    for i in range(7):
        for j in range(9):
            alpha = 0.8 * math.exp(-0.5 * ((i - 3) ** 2 + (j - 4) ** 2) / variance)
            alpha = alpha if alpha >= 1 / 255 else 0.0
            expected = [
                alpha * c + (1 - alpha) * b for c, b in zip((0.9, 0.1, 0.4), (0.25, 0.5, 0.75), strict=True)
            ]
            assert alphas[0, i, j].item() == pytest.approx(alpha, abs=1e-15)
            assert render[0, i, j].tolist() == pytest.approx(expected, abs=1e-15)
    assert alphas[0, 0, 0].item() == 0.0  # the corner lies outside the support
    assert meta["means2d"][0, 0].tolist() == [4.5, 3.5]
    assert meta["depths"][0, 0].item() == 2.0
    assert meta["conics"][0, 0].tolist() == pytest.approx([1 / variance, 0.0, 1 / variance])
    assert meta["radii"][0, 0].tolist() == [math.ceil(math.sqrt(2 * math.log(255 * 0.8) * variance))] * 2
    assert meta["radii"].dtype == torch.int32


def test_two_gaussians_blend_front_to_back() -> None:
    scene = frontal(TWO, [0.6, 0.3], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    render, alphas, _ = reference_rasterization(**scene.arguments())
    rest = 0.7 * 0.4
    expected = [0.7 * 0.6 + rest * 0.25, 0.3 + rest * 0.5, rest * 0.75]
    assert render[0, 3, 4].tolist() == pytest.approx(expected, abs=1e-15)
    assert alphas[0, 3, 4].item() == pytest.approx(1 - rest, abs=1e-15)


def test_depth_modes() -> None:
    scene = frontal(TWO, [0.6, 0.3], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    depth = 0.3 * 2.0 + 0.7 * 0.6 * 4.0
    alpha = 1 - 0.7 * 0.4
    color = reference_rasterization(**scene.arguments())[0]
    for mode, channels, value in (
        ("D", 1, depth),
        ("ED", 1, depth / alpha),
        ("RGB+D", 4, depth),
        ("RGB+ED", 4, depth / alpha),
    ):
        render = reference_rasterization(**scene.arguments(), render_mode=mode)[0]
        assert render.shape == (1, 7, 9, channels)
        assert render[0, 3, 4, -1].item() == pytest.approx(value, abs=1e-14)
        assert torch.equal(render[..., :-1], color[..., : channels - 1])
        assert render[0, 0, 0, -1].item() == 0.0  # no background depth


def test_cap_stop_and_permanence() -> None:
    """Four layers of 0.95: a fourth would leave T = 6.25e-6, so it stops the pixel for the rest too."""
    means = [[0.0, 0.0, 2.0 + k] for k in range(6)]
    scene = frontal(means, [0.95, 0.95, 0.95, 0.95, 0.1, 0.1], [[1.0, 0.0, 0.0]] * 6)
    _, alphas, _ = reference_rasterization(**scene.arguments())
    assert 1 - alphas[0, 3, 4].item() == pytest.approx(0.05**3, rel=1e-9)
    capped = frontal(means[:1], [0.999], [[1.0, 1.0, 1.0]]).with_grad("opacities")
    _, alphas, meta = reference_rasterization(**capped.arguments())
    assert alphas[0, 3, 4].item() == pytest.approx(0.99, abs=1e-15)
    assert meta["cap_margin"][0, 3, 4].item() == pytest.approx(0.999 / 0.99 - 1, rel=1e-9)
    alphas[0, 3, 4].sum().backward()
    assert capped.opacities.grad is not None
    assert capped.opacities.grad.item() == 0.0


def test_min_margin_sees_both_jumps() -> None:
    floor = frontal([[0.0, 0.0, 2.0]], [(1 + 1e-6) / 255], [[1.0, 1.0, 1.0]])
    layers = [[0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 0.0, 4.0]]  # 0.05^2 * 0.03996 = 0.999e-4
    stop = frontal(layers, [0.95, 0.95, 1 - 0.03996 * (1 + 1e-6)], [[1.0, 1.0, 1.0]] * 3)
    for scene in (floor, stop):
        margin = reference_rasterization(**scene.arguments())[2]["min_margin"]
        assert margin[0, 3, 4].item() == pytest.approx(1e-6, rel=1e-6)


def test_order_is_depth_then_index() -> None:
    means = [[0.0, 0.0, 3.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 0.0, 2.0]]
    scene = frontal(means, [0.5] * 4, torch.eye(4).tolist())
    scene = replace(scene, backgrounds=torch.zeros(1, 4, dtype=F64))
    render = reference_rasterization(**scene.arguments())[0]
    assert render[0, 3, 4].tolist() == [0.125, 0.5, 0.0625, 0.25]


def rodrigues(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation [3, 3] by `angle` around the unit vector `axis`."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


@pytest.mark.parametrize("seed", range(5))
def test_projection_by_finite_differences(seed: int) -> None:
    """cov2d = Jn R Sigma R^T Jn^T + 0.3 I: Jn from differences of the pinhole map, rotations by Rodrigues."""
    rng = np.random.default_rng(seed)
    axis, view_axis = (a / np.linalg.norm(a) for a in rng.normal(size=(2, 3)))
    angle = rng.uniform(0.2, 3.0)
    R, t = rodrigues(view_axis, 0.7), rng.normal(size=3)
    in_camera = np.array([0.8, -0.5, 3.0]) + rng.uniform(-0.2, 0.2, 3)
    scales = np.array([0.3, 0.02, 0.7])
    K = np.array([[40.0, 0.0, 21.0], [0.0, 37.0, 17.0], [0.0, 0.0, 1.0]])

    def pinhole(p: np.ndarray) -> np.ndarray:
        return (K @ p / p[2])[:2]

    h = 1e-5
    Jn = np.stack([pinhole(in_camera + h * e) - pinhole(in_camera - h * e) for e in np.eye(3)], axis=1) / (
        2 * h
    )
    Rq = rodrigues(axis, angle)
    plain = Jn @ R @ Rq @ np.diag(scales**2) @ Rq.T @ R.T @ Jn.T
    cov2d = plain + 0.3 * np.eye(2)
    conic = np.linalg.inv(cov2d)
    opacity = 0.9 * math.sqrt(np.linalg.det(plain) / np.linalg.det(cov2d))
    extents = np.sqrt(2 * np.log(255 * opacity) * np.diag(cov2d))

    viewmat = torch.eye(4, dtype=F64)
    viewmat[:3, :3], viewmat[:3, 3] = torch.tensor(R), torch.tensor(t)
    scene = replace(
        frontal([(R.T @ (in_camera - t)).tolist()], [0.9], [[1.0, 1.0, 1.0]]),
        quats=1.7 * torch.tensor([[math.cos(angle / 2), *(math.sin(angle / 2) * axis)]], dtype=F64),
        scales=torch.tensor(scales)[None],
        viewmats=viewmat[None],
        Ks=torch.tensor(K)[None],
        width=45,
        height=33,
    )
    meta = reference_rasterization(**scene.arguments(), rasterize_mode="antialiased")[2]
    assert meta["means2d"][0, 0].tolist() == pytest.approx(pinhole(in_camera).tolist(), rel=1e-12)
    assert meta["depths"][0, 0].item() == pytest.approx(in_camera[2], rel=1e-12)
    assert meta["conics"][0, 0].tolist() == pytest.approx([conic[0, 0], conic[0, 1], conic[1, 1]], rel=1e-7)
    assert meta["opacities"][0, 0].item() == pytest.approx(opacity, rel=1e-7)
    assert meta["extents"][0, 0].tolist() == pytest.approx(extents.tolist(), rel=1e-7)


def test_jacobian_is_clamped_outside_the_view() -> None:
    """Far right, x/z becomes (width - cx)/fx + 0.3 width/(2 fx); the mean itself is not clamped."""
    scene = frontal([[6.0, 0.0, 2.0]], [0.9], [[1.0, 1.0, 1.0]], scale=2.0)
    meta = reference_rasterization(**scene.arguments())[2]
    limit = 4.5 / 10 + 0.3 * 9 / 20
    xx = (10 * 2 / 2) ** 2 * (1 + limit**2) + 0.3
    yy = (10 * 2 / 2) ** 2 + 0.3
    assert meta["means2d"][0, 0].tolist() == pytest.approx([34.5, 3.5])
    assert meta["conics"][0, 0].tolist() == pytest.approx([1 / xx, 0.0, 1 / yy])


def real_sh(degree: int, order: int, dirs: np.ndarray) -> np.ndarray:
    """Real SH from associated Legendre functions (with the Condon-Shortley sign) and their normalisation."""
    m = abs(order)
    cos_theta, phi = dirs[:, 2], np.arctan2(dirs[:, 1], dirs[:, 0])
    coefficients = legendre.Legendre.basis(degree).deriv(m) if m else legendre.Legendre.basis(degree)
    associated = (-1) ** m * (1 - cos_theta**2) ** (m / 2) * coefficients(cos_theta)
    norm = math.sqrt(
        (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
    )
    if order == 0:
        return norm * associated
    return math.sqrt(2) * norm * associated * (np.cos(m * phi) if order > 0 else np.sin(m * phi))


def test_sh_basis_is_the_real_sh() -> None:
    dirs = np.random.default_rng(0).normal(size=(200, 3))
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    expected = np.stack([real_sh(d, m, dirs) for d in range(4) for m in range(-d, d + 1)], axis=1)
    np.testing.assert_allclose(sh_basis(torch.tensor(dirs)).numpy(), expected, atol=1e-13)


def test_sh_direction_runs_from_the_camera_to_the_gaussian() -> None:
    """A Gaussian along world x from the camera sees -x of degree 1; one on the camera only degree 0."""
    R = rotation_matrices(torch.tensor([[0.3, -0.5, 0.7, 0.2]], dtype=F64))[0]
    center = torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    viewmat = torch.eye(4, dtype=F64)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ center
    means = (center + torch.tensor([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=F64)).requires_grad_()
    coefficients = torch.tensor([0.1, 0.2, 0.3, -0.4], dtype=F64)[None, :, None].repeat(2, 1, 3)
    with torch.no_grad():  # the offset of the second one must be exactly 0, whatever the solve rounds to
        means[1] = -torch.linalg.solve(R, viewmat[:3, 3])
    colors = sh_colors(coefficients, means, viewmat, 1)
    y00, y1 = 0.5 / math.sqrt(math.pi), math.sqrt(3 / (4 * math.pi))
    assert colors[0, 0].item() == pytest.approx(0.5 + 0.1 * y00 + 0.4 * y1, rel=1e-12)
    assert colors[1, 0].item() == pytest.approx(0.5 + 0.1 * y00, rel=1e-12)
    colors.sum().backward()
    assert means.grad is not None
    assert means.grad[1].tolist() == [0.0, 0.0, 0.0]


def test_culled_gaussians_have_no_say() -> None:
    """NaN, zero quaternion, behind the camera, off-screen, too faint: radii 0, the image of the rest."""
    scene = random_scene(30, 20, 15, seed=2, hidden=0.0)
    means, quats, opacities = scene.means.clone(), scene.quats.clone(), scene.opacities.clone()
    means[0, 1] = math.nan
    quats[1] = 0.0
    center = -torch.linalg.solve(scene.viewmats[0, :3, :3], scene.viewmats[0, :3, 3])
    means[2] = 2 * center - means[2]
    means[3] = means[3] + 1e3 * scene.viewmats[0, 0, :3]
    opacities[4] = 0.9 / 255
    broken = replace(scene, means=means, quats=quats, opacities=opacities).with_grad(*INPUTS)
    render, alphas, meta = reference_rasterization(**broken.arguments())
    assert (meta["radii"][0, :5] == 0).all()
    rest = broken.pick(torch.arange(5, 30))
    assert torch.equal(render, reference_rasterization(**rest.arguments())[0])
    (render.sum() + alphas.sum()).backward()
    for name in INPUTS[:5]:
        grad = getattr(broken, name).grad
        assert torch.isfinite(grad).all()
        assert (grad[:5] == 0).all()
