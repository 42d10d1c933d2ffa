"""What `hqgs.rasterization` culls, and what must not matter to it: memory layout and hints."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scenes import GaussianScene, random_scene
from torch import Tensor

import hqgs
from hqgs.model.rasterization import RasterizationMeta

F32, F64 = torch.float32, torch.float64
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")
SLOTS = [(name, slot) for name, size in zip(GAUSSIANS, (3, 4, 3, 1, 3), strict=True) for slot in range(size)]
both_dtypes = pytest.mark.parametrize("dtype", [F64, F32], ids=["f64", "f32"])


def backward(
    scene: GaussianScene, **options: Any
) -> tuple[Tensor, Tensor, RasterizationMeta, dict[str, Tensor]]:
    """Render, alphas, meta and the gradients of a fixed random loss for every input."""
    leaves = scene.with_grad(*INPUTS)
    render, alphas, meta = hqgs.rasterization(**leaves.arguments(**options))
    generator = torch.Generator().manual_seed(3)
    loss = (render * torch.randn(render.shape, generator=generator, dtype=render.dtype)).sum()
    loss = loss + (alphas * torch.randn(alphas.shape, generator=generator, dtype=alphas.dtype)).sum()
    loss.backward()
    gradients = {name: getattr(leaves, name).grad for name in INPUTS}
    return render.detach(), alphas.detach(), meta, gradients


def frontal(depths: list[float], dtype: torch.dtype) -> GaussianScene:
    """One Gaussian per depth on the axis of a camera at the origin; each covers the whole image faintly."""
    n = len(depths)
    means = torch.zeros(n, 3, dtype=dtype)
    means[:, 2] = torch.tensor(depths, dtype=dtype)
    return replace(
        random_scene(n, 12, 9, seed=0, dtype=dtype),
        means=means,
        scales=(0.5 * means[:, 2:].abs()).expand(n, 3),
        opacities=torch.full((n,), 0.3, dtype=dtype),
        viewmats=torch.eye(4, dtype=dtype)[None],
    )


# --- culling


@both_dtypes
def test_near_and_far_planes_to_the_last_bit(dtype: torch.dtype) -> None:
    near, far = 0.5, 8.0
    kind = np.float32 if dtype == F32 else np.float64
    inside = [near, np.nextafter(kind(near), kind(1)), np.nextafter(kind(far), kind(1)), far]
    outside = [np.nextafter(kind(near), kind(0)), np.nextafter(kind(far), kind(9)), -near, 0.0]
    scene = frontal([float(z) for z in inside + outside], dtype)
    render, _, meta, gradients = backward(scene, near_plane=near, far_plane=far)
    assert (meta["radii"][0] > 0).all(-1).tolist() == [True] * 4 + [False] * 4
    assert torch.equal(render, hqgs.rasterization(**scene.pick(torch.arange(4)).arguments())[0])
    for name in GAUSSIANS:
        assert torch.isfinite(gradients[name]).all()
        assert (gradients[name][4:] == 0).all(), name
    assert (gradients["colors"][:4] != 0).all()


@both_dtypes
def test_quaternions_shorter_than_the_limit_are_culled(dtype: torch.dtype) -> None:
    scene = frontal([2.0, 3.0, 4.0], dtype)
    unit = scene.quats / scene.quats.norm(dim=1, keepdim=True)
    lengths = torch.tensor([0.0, 0.98e-6, 1.02e-6], dtype=dtype)
    short = replace(scene, quats=unit * lengths[:, None])
    render, _, meta, gradients = backward(short)
    assert (meta["radii"][0] > 0).all(-1).tolist() == [False, False, True]
    expected = hqgs.rasterization(**replace(scene, quats=unit).pick(torch.tensor([2])).arguments())[0]
    torch.testing.assert_close(render, expected, rtol=1e-5, atol=1e-6)
    for name in GAUSSIANS:
        assert torch.isfinite(gradients[name]).all()
        assert (gradients[name][:2] == 0).all(), name


@both_dtypes
@pytest.mark.parametrize("sh_degree", [None, 2])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_one_bad_number_culls_one_gaussian(value: float, sh_degree: int | None, dtype: torch.dtype) -> None:
    """Each slot of each input in turn: image and gradients are those of the scene without that Gaussian."""
    n = 24
    scene = random_scene(n, 20, 15, seed=11, dtype=dtype, sh_degree=sh_degree, hidden=0.0)
    visible = (hqgs.rasterization(**scene.arguments())[2]["radii"][0] > 0).all(-1)
    victim = int(visible.nonzero()[3])
    rest = torch.tensor([i for i in range(n) if i != victim])
    render, alphas, _, gradients = backward(scene.pick(rest))
    for name, slot in SLOTS:
        tensor = getattr(scene, name).clone()
        row = tensor[victim : victim + 1].reshape(-1) if name == "opacities" else tensor[victim].reshape(-1)
        row[slot] = value  # for SH: red, green and blue of degree 0
        bad = replace(scene, **{name: tensor})
        bad_render, bad_alphas, meta, bad_gradients = backward(bad)
        where = f"{name}[{slot}] = {value}"
        assert meta["radii"][0, victim].tolist() == [0, 0], where
        assert torch.equal(bad_render, render), where
        assert torch.equal(bad_alphas, alphas), where
        for key, gradient in bad_gradients.items():
            others = gradient[rest] if key in GAUSSIANS else gradient
            torch.testing.assert_close(others, gradients[key], rtol=1e-5, atol=1e-5, msg=f"{where}: {key}")
            assert key not in GAUSSIANS or (gradient[victim] == 0).all(), f"{where}: {key}"


@both_dtypes
@pytest.mark.parametrize("value", [0.0, -0.0, -1.0, 1e-38, 1e-20, 1e20, 3e38, -3e38])
def test_extreme_finite_numbers_stay_finite(value: float, dtype: torch.dtype) -> None:
    scene = random_scene(24, 20, 15, seed=12, dtype=dtype, hidden=0.0)
    for name, slot in SLOTS:
        if name == "colors" and abs(value) > 1e19:
            continue  # the products of such a color overflow by right
        tensor = getattr(scene, name).clone()
        tensor.reshape(24, -1)[5, slot] = value
        render, alphas, _, gradients = backward(
            replace(scene, **{name: tensor}), rasterize_mode="antialiased"
        )
        for key, result in {"render": render, "alphas": alphas, **gradients}.items():
            assert torch.isfinite(result).all(), f"{name}[{slot}] = {value}: {key}"


@both_dtypes
def test_a_slope_that_overflows_does_not_spoil_the_gradient(dtype: torch.dtype) -> None:
    """On the axis this harmonic is 0, and so is the cotangent of its channel; its slope is infinite."""
    scene = frontal([2.0, 3.0], dtype)
    colors = torch.zeros(2, 16, 3, dtype=dtype)
    colors[:, 0] = 0.5
    colors[0, 11, 1] = torch.finfo(dtype).max
    leaves = replace(scene, colors=colors).with_grad(*GAUSSIANS)
    render, _, _ = hqgs.rasterization(**leaves.arguments(sh_degree=3))
    assert render.isfinite().all()
    render[..., 0].sum().backward()
    for name in GAUSSIANS:
        assert getattr(leaves, name).grad.isfinite().all(), name


@both_dtypes
def test_no_gaussians(dtype: torch.dtype) -> None:
    scene = random_scene(4, 20, 15, cameras=2, seed=0, dtype=dtype).pick(torch.arange(0))
    render, alphas, meta, gradients = backward(scene)
    assert torch.equal(render, scene.backgrounds[:, None, None].expand(2, 15, 20, 3))
    assert (alphas == 0).all()
    assert meta["radii"].shape == (2, 0, 2)
    assert gradients["means"].shape == (0, 3)
    assert (gradients["viewmats"] == 0).all()


@both_dtypes
@pytest.mark.parametrize("render_mode", ["RGB", "ED", "RGB+ED"])
def test_nothing_visible(render_mode: str, dtype: torch.dtype) -> None:
    scene = random_scene(30, 20, 15, seed=0, dtype=dtype, hidden=1.0)
    leaves = scene.with_grad(*INPUTS)
    render, alphas, meta = hqgs.rasterization(**leaves.arguments(), render_mode=render_mode)
    assert (meta["radii"] == 0).all()
    assert (alphas == 0).all()
    if render_mode.startswith("RGB"):
        assert torch.equal(render[..., :3], scene.backgrounds[:, None, None].expand(1, 15, 20, 3))
    if render_mode.endswith("ED"):
        assert (render[..., -1] == 0).all()
    (render.sum() + alphas.sum()).backward()
    for name in (*GAUSSIANS, "viewmats"):
        gradient = getattr(leaves, name).grad
        if name == "colors" and gradient is None and render_mode == "ED":
            continue  # a depth image does not use them
        assert gradient is not None
        assert (gradient == 0).all(), name


# --- layouts and hints


def transposed(x: Tensor) -> Tensor:
    return x.transpose(0, -1).contiguous().transpose(0, -1)


def strided(x: Tensor) -> Tensor:
    return torch.stack([x, torch.full_like(x, 7.0)], dim=-1)[..., 0]


def sliced(x: Tensor) -> Tensor:
    return torch.cat([torch.full_like(x[:1], 7.0), x])[1:]


@pytest.mark.parametrize("layout", [transposed, strided, sliced])
@pytest.mark.parametrize("sh_degree", [None, 1])
def test_memory_layout_does_not_matter(layout: Callable[[Tensor], Tensor], sh_degree: int | None) -> None:
    scene = random_scene(60, 25, 18, cameras=2, seed=1, sh_degree=sh_degree)
    render, alphas, _, gradients = backward(scene)
    leaves = scene.with_grad(*INPUTS)
    arranged = {name: layout(tensor) for name, tensor in leaves.tensors().items()}
    if layout is not sliced:
        assert not arranged["means"].is_contiguous()
    other_render, other_alphas, _ = hqgs.rasterization(**leaves.arguments(**arranged))
    assert torch.equal(other_render, render)
    assert torch.equal(other_alphas, alphas)
    generator = torch.Generator().manual_seed(3)
    loss = (other_render * transposed(torch.randn(render.shape, generator=generator, dtype=F64))).sum()
    loss = loss + (other_alphas * torch.randn(alphas.shape, generator=generator, dtype=F64)).sum()
    loss.backward()
    for name in INPUTS:
        assert torch.equal(getattr(leaves, name).grad, gradients[name]), name


def test_expanded_inputs() -> None:
    """Isotropic scales, one color and one camera seen twice, as views of stride 0; stride-0 cotangents."""
    scene = random_scene(40, 25, 18, cameras=2, seed=2)
    size = scene.scales[:, :1].clone().requires_grad_()
    views = {
        "scales": size.expand(40, 3),
        "colors": scene.colors[:1].expand(40, 3),
        "viewmats": scene.viewmats[:1].expand(2, 4, 4),
        "Ks": scene.Ks[:1].expand(2, 3, 3),
    }
    copies = {name: view.detach().clone().requires_grad_(name == "scales") for name, view in views.items()}
    render, _, _ = hqgs.rasterization(**scene.arguments(**views))
    expected, _, _ = hqgs.rasterization(**scene.arguments(**copies))
    assert torch.equal(render, expected)
    render.sum().backward()
    (expected * 1.0).sum().backward()
    assert size.grad is not None
    assert copies["scales"].grad is not None
    torch.testing.assert_close(size.grad, copies["scales"].grad.sum(1, keepdim=True), rtol=1e-12, atol=1e-12)


@both_dtypes
@pytest.mark.parametrize(
    "hint",
    [{"sparse_grad": True}, {"tile_size": 8}, {"tile_size": 32}, {"channel_chunk": 2}, {"channel_chunk": 64}],
    ids=str,
)
def test_hints_change_no_bit(hint: dict[str, Any], dtype: torch.dtype) -> None:
    scene = random_scene(150, 50, 37, cameras=2, seed=3, dtype=dtype, channels=5)
    render, alphas, meta, gradients = backward(scene)
    other_render, other_alphas, other_meta, other_gradients = backward(scene, **hint)
    assert torch.equal(render, other_render)
    assert torch.equal(alphas, other_alphas)
    for name in ("means2d", "depths", "conics", "radii", "opacities"):
        assert torch.equal(meta[name], other_meta[name]), name
    for name in INPUTS:
        assert torch.equal(gradients[name], other_gradients[name]), name


@both_dtypes
def test_inputs_are_not_modified(dtype: torch.dtype) -> None:
    leaves = random_scene(60, 25, 18, cameras=2, seed=4, dtype=dtype, sh_degree=2).with_grad(*INPUTS)
    before = leaves.with_grad()
    render = hqgs.rasterization(**leaves.arguments(), render_mode="RGB+D", absgrad=True)[0]
    cotangent = torch.ones_like(render)
    (render * cotangent).sum().backward()
    for name, tensor in leaves.tensors().items():
        assert torch.equal(tensor.detach(), getattr(before, name)), name
    assert (cotangent == 1).all()


@both_dtypes
def test_two_capped_layers_blend_in_either_precision(dtype: torch.dtype) -> None:
    """(1 - 0.99)^2 is 1e-4, the field's stop: there rounding would decide about the second layer."""
    scene = frontal([2.0, 3.0], dtype)
    alphas = hqgs.rasterization(**scene.arguments(opacities=torch.ones(2, dtype=dtype)))[1]
    assert alphas.max().item() == pytest.approx(0.9999, abs=1e-6)


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_needles_are_right_in_single_precision(ratio: float) -> None:
    """Across the image at 37 degrees; the naive determinant is wrong by a factor of 7 at 1e4."""
    half = math.radians(37.0) / 2
    numbers: dict[str, Any] = {
        "means": [[0.01, -0.02, 2.0], [0.3, 0.1, 3.0]],
        "quats": [[math.cos(half), 0.0, 0.0, math.sin(half)], [1.0, 0.2, -0.3, 0.4]],
        "scales": [[0.002 * ratio, 0.002, 0.002], [0.2, 0.1, 0.3]],
        "opacities": [0.9, 0.7],
        "colors": [[0.9, 0.4, 0.2], [0.1, 0.6, 0.8]],
        "viewmats": torch.eye(4)[None].tolist(),
        "Ks": [[[500.0, 0.0, 100.0], [0.0, 500.0, 80.0], [0.0, 0.0, 1.0]]],
    }
    results = []
    for dtype in (torch.float32, torch.float64):
        # The same numbers in both precisions.
        inputs: dict[str, Any] = {
            name: torch.tensor(value).to(dtype).requires_grad_() for name, value in numbers.items()
        }
        inputs["Ks"] = inputs["Ks"].detach()
        render, _, meta = hqgs.rasterization(**inputs, width=200, height=160)
        weights = torch.rand(render.shape, generator=torch.Generator().manual_seed(3)).to(dtype)
        (render * weights).sum().backward()
        gradients = {name: t.grad.double() for name, t in inputs.items() if t.grad is not None}
        results.append((render.detach().double(), meta["conics"].detach().double(), gradients))
    (render, conics, gradients), (expected_render, expected_conics, expected_gradients) = results
    assert (render - expected_render).abs().max() < 2e-5
    assert expected_render.amax() > 0.5
    torch.testing.assert_close(conics, expected_conics, rtol=1e-6, atol=0.0)
    for name, expected in expected_gradients.items():
        error = (gradients[name] - expected).norm() / expected.norm()
        assert error < 1e-5, f"{name}: {error}"
