"""`covars` of `hqgs.rasterization`: the picture of their quats and scales, and the gradient of each entry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from reference import reference_rasterization, rotation_matrices, safe_pixels
from scenes import GaussianScene, random_scene
from torch import Tensor

import hqgs

F32, F64 = torch.float32, torch.float64
OPTIONS = {"classic": {}, "antialiased-RGB+ED": {"rasterize_mode": "antialiased", "render_mode": "RGB+ED"}}


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """R S S^T R^T, [N, 3, 3]."""
    M = rotation_matrices(quats) * scales[:, None, :]
    return M @ M.mT


@pytest.mark.parametrize(("dtype", "error"), [(F64, 1e-9), (F32, 2e-4)])
@pytest.mark.parametrize("batch", [False, True])
def test_the_picture_is_that_of_quats_and_scales(dtype: torch.dtype, error: float, batch: bool) -> None:
    scene = random_scene(60, 24, 18, seed=5, dtype=dtype, anisotropy=20.0)
    arguments = scene.arguments(quats=None, scales=None)
    covars = covariances(scene.quats, scene.scales)
    if batch:
        arguments |= {name: t[None] for name, t in arguments.items() if isinstance(t, Tensor)}
        covars = covars[None]
    plain = hqgs.rasterization(**scene.arguments())[0]
    image = hqgs.rasterization(**arguments, covars=covars)[0]
    assert (image - plain).abs().max() < error
    assert plain.std() > 0.05
    below = covars + torch.tensor([[0, 0, 0], [9, 0, 0], [torch.nan, 9, 0]], dtype=dtype)
    assert torch.equal(hqgs.rasterization(**arguments, covars=below)[0], image), "not the upper entries alone"


def test_round_flat_and_broken_ones() -> None:
    scene = random_scene(4, 24, 18, seed=5, dtype=F64)
    matrices = torch.stack(
        [
            0.04 * torch.eye(3, dtype=F64),
            torch.diag(torch.tensor([0.04, 0.01, 0.0], dtype=F64)),
            -torch.eye(3, dtype=F64),
            torch.full((3, 3), torch.nan, dtype=F64),
        ]
    ).requires_grad_()
    scene = scene.with_grad("means", "colors")
    image, _, meta = hqgs.rasterization(**scene.arguments(), covars=matrices)
    plain, _, known = hqgs.rasterization(
        **scene.arguments(
            quats=torch.tensor([1.0, 0, 0, 0]).double().expand(4, 4),
            scales=torch.tensor([[0.2] * 3, [0.2, 0.1, 0.0], [0.0] * 3, [torch.nan] * 3], dtype=F64),
        )
    )
    assert torch.equal(meta["radii"], known["radii"])
    assert (image - plain).abs().max() < 1e-9
    image.square().sum().backward()
    for tensor in (scene.means, matrices):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
    assert matrices.grad is not None
    assert matrices.grad[:2].any()
    assert not matrices.grad[3].any(), "it is culled"


@pytest.mark.parametrize("case", OPTIONS)
@pytest.mark.parametrize("shape", ["any", "round"])
def test_each_entry_against_finite_differences(shape: str, case: str) -> None:
    """The whole Jacobian, of two cameras. Round ones have no rotation that could be differentiated."""
    options = OPTIONS[case]
    scene = next(smooth_scenes(shape == "round", options))
    covars = covariances(scene.quats, scene.scales).requires_grad_()

    def render(value: Tensor) -> tuple[Tensor, Tensor]:
        arguments = scene.arguments(**options, quats=None, scales=None, covars=value)
        return hqgs.rasterization(**arguments)[:2]

    assert torch.autograd.gradcheck(render, covars, eps=1e-7, atol=1e-5, rtol=1e-4)
    loss = sum(
        (image * torch.linspace(-1, 1, image.numel()).view(image.shape)).sum() for image in render(covars)
    )
    (gradient,) = torch.autograd.grad(loss, covars)  # type: ignore[arg-type]
    assert (gradient.triu(1) != 0).any((1, 2)).sum() >= 3
    assert not gradient.tril(-1).any()


def smooth_scenes(are_round: bool, options: dict[str, Any]) -> Iterator[GaussianScene]:
    """Scenes of five Gaussians whose pixels are all smooth in them, of which four at least are seen."""
    for seed in range(1000):
        scene = random_scene(5, 8, 6, seed=seed, cameras=2, hidden=0.0, anisotropy=5.0)
        if are_round:
            scene = replace(scene, scales=scene.scales[:, :1].expand(-1, 3).contiguous())
        meta = reference_rasterization(**scene.arguments(**options))[2]
        margins = torch.stack([meta[name] for name in ("min_margin", "cap_margin", "order_margin")])
        if margins.min() > 1e-4 and (meta["radii"] > 0).all(-1).sum(1).min() >= 4:
            yield scene


@pytest.mark.parametrize(("dtype", "tolerance"), [(F64, 1e-8), (F32, 2e-3)])
@pytest.mark.parametrize("case", OPTIONS)
def test_who_builds_them_gets_the_gradient_of_rotations_and_scales(
    case: str, dtype: torch.dtype, tolerance: float
) -> None:
    """Against the reference's autograd, which knows of no covariance."""
    options = OPTIONS[case]
    scene = random_scene(150, 40, 27, seed=5, dtype=dtype, cameras=2, anisotropy=10.0)
    wanted = scene.to(F64).with_grad("quats", "scales", "means", "viewmats")
    mine = scene.with_grad("quats", "scales", "means", "viewmats")
    image, alphas, meta = reference_rasterization(**wanted.arguments(**options))
    safe = safe_pixels(meta, dtype, smooth=True)[..., None]
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(7), dtype=F64) * safe
    ((image * weights).sum() + (alphas * safe).sum()).backward()
    covars = covariances(mine.quats, mine.scales)
    arguments = mine.arguments(**options, quats=None, scales=None, covars=covars)
    image, alphas, _ = hqgs.rasterization(**arguments)
    ((image * weights.to(dtype)).sum() + (alphas * safe).sum()).backward()
    for name in ("quats", "scales", "means", "viewmats"):
        a, b = getattr(mine, name).grad, getattr(wanted, name).grad
        assert a.dtype == dtype
        assert b.norm() > 0
        assert ((a - b).norm() / b.norm()).item() < tolerance, name


def test_same_bits_at_any_number_of_threads_and_in_a_batch() -> None:
    scene = random_scene(3000, 60, 40, seed=2, dtype=F32, anisotropy=10.0)
    covars = covariances(scene.quats, scene.scales)

    def gradient(*, batch: bool) -> Tensor:
        given = (covars[None] if batch else covars).clone().requires_grad_()
        arguments = scene.arguments(quats=None, scales=None)
        if batch:
            arguments |= {name: t[None] for name, t in arguments.items() if isinstance(t, Tensor)}
        hqgs.rasterization(**arguments, covars=given)[0].square().sum().backward()
        assert given.grad is not None
        return given.grad

    hqgs.set_num_threads(1)
    one = gradient(batch=False)
    hqgs.set_num_threads(3)
    assert torch.equal(gradient(batch=False), one)
    assert torch.equal(gradient(batch=True)[0], one)
    assert one.any()
