"""Properties of `hqgs.rasterization` that must hold for any scene; the scenes are found by hypothesis."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from reference import rotation_matrices
from scenes import GaussianScene, random_scene
from torch import Tensor

import hqgs

F32, F64 = torch.float32, torch.float64
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")
EXTREMES = [0.0, 1e-45, 1e-38, 1e-30, 1e-20, 1e-10, 1e-3, 1.0, 1e3, 1e10, 1e18, 1e20, 1e30, 3e38]
always_the_same = settings(deadline=None, derandomize=True, max_examples=40)


@st.composite
def scenes(draw: DrawFn, dtypes: tuple[torch.dtype, ...] = (F32, F64)) -> GaussianScene:
    """Up to 60 Gaussians of very different sizes; images from a pixel to several tiles; 1 or 2 cameras."""
    return random_scene(
        n=draw(st.integers(1, 60)),
        width=draw(st.integers(1, 50)),
        height=draw(st.integers(1, 50)),
        cameras=draw(st.integers(1, 2)),
        seed=draw(st.integers(0, 2**32 - 1)),
        dtype=draw(st.sampled_from(dtypes)),
        channels=draw(st.integers(1, 5)),
        anisotropy=draw(st.sampled_from([1.0, 10.0, 1e4])),
        largest=draw(st.sampled_from([0.1, 0.5, 3.0])),
        opacity=draw(st.sampled_from([(0.02, 0.999), (0.9, 1.0), (0.002, 0.05)])),
    )


def modes() -> SearchStrategy[dict[str, Any]]:
    return st.sampled_from([{"rasterize_mode": "classic"}, {"rasterize_mode": "antialiased"}, {"eps2d": 0.0}])


def picture(scene: GaussianScene, **options: Any) -> tuple[Tensor, Tensor]:
    render, alphas, _ = hqgs.rasterization(**scene.arguments(**options))
    return render, alphas


def gradients(scene: GaussianScene, **options: Any) -> dict[str, Tensor]:
    """Of a fixed random weighting of colours and alphas, for every input."""
    leaves = scene.with_grad(*INPUTS)
    render, alphas, _ = hqgs.rasterization(**leaves.arguments(**options))
    _weighted(render, alphas).backward()
    return {name: getattr(leaves, name).grad for name in INPUTS}


def _weighted(render: Tensor, alphas: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    weights = (torch.randn(t.shape, generator=generator, dtype=F64).to(t.dtype) for t in (render, alphas))
    return sum(
        ((t * w).sum() for t, w in zip((render, alphas), weights, strict=True)), start=render.new_zeros(())
    )


@always_the_same
@given(scenes(), modes())
def test_alphas_are_shares_and_colours_convex_combinations(
    scene: GaussianScene, options: dict[str, Any]
) -> None:
    render, alphas = picture(scene, **options)
    assert ((alphas >= 0) & (alphas <= 1)).all()
    rounding = 1e-5 if scene.means.dtype == F32 else 1e-12
    for c in range(len(scene.viewmats)):
        palette = torch.cat([scene.colors, scene.backgrounds[c : c + 1]])
        assert (render[c] >= palette.amin(0) - rounding).all()
        assert (render[c] <= palette.amax(0) + rounding).all()
    ones = replace(
        scene, colors=torch.ones_like(scene.colors), backgrounds=torch.zeros_like(scene.backgrounds)
    )
    torch.testing.assert_close(picture(ones, **options)[0], alphas.expand_as(render), rtol=0.0, atol=rounding)


@always_the_same
@given(scenes(), modes(), st.randoms(use_true_random=False))
def test_the_order_of_the_input_changes_no_bit(
    scene: GaussianScene, options: dict[str, Any], random: Any
) -> None:
    order = list(range(len(scene.means)))
    random.shuffle(order)
    ids = torch.tensor(order)
    for a, b in zip(picture(scene, **options), picture(scene.pick(ids), **options), strict=True):
        assert torch.equal(a, b)
    before, after = gradients(scene, **options), gradients(scene.pick(ids), **options)
    for name in GAUSSIANS:
        assert torch.equal(after[name], before[name][ids]), name


@st.composite
def invisible(draw: DrawFn, scene: GaussianScene) -> dict[str, Tensor]:
    """A Gaussian that no camera shows, as rows for the tensors of a scene."""
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    source = scene.pick(torch.tensor([int(rng.integers(len(scene.means)))]))
    row = {name: getattr(source, name).clone() for name in GAUSSIANS}
    why = draw(
        st.sampled_from(["transparent", "no rotation", "nan", "infinite", "on the camera", "far away"])
    )
    if why == "transparent":
        row["opacities"][:] = draw(st.sampled_from([0.0, -1.0, 0.0039]))
    elif why == "no rotation":
        row["quats"] *= 1e-9
    elif why == "nan":
        row[draw(st.sampled_from(["means", "quats", "scales", "opacities"]))][:] = math.nan
    elif why == "infinite":
        row[draw(st.sampled_from(["means", "scales"]))][:] = math.inf
    elif why == "on the camera":
        viewmat = scene.viewmats[0]
        row["means"][:] = -viewmat[:3, :3].T @ viewmat[:3, 3]
    else:
        row["means"][:] = 1e12
    return row


@always_the_same
@given(st.data(), scenes(), modes())
def test_an_invisible_gaussian_changes_no_bit(
    data: st.DataObject, scene: GaussianScene, options: dict[str, Any]
) -> None:
    scene = replace(
        scene, viewmats=scene.viewmats[:1], Ks=scene.Ks[:1], backgrounds=scene.backgrounds[:1]
    )  # another camera might see it
    row = data.draw(invisible(scene))
    at = data.draw(st.integers(0, len(scene.means)))
    joined = {
        name: torch.cat([getattr(scene, name)[:at], row[name], getattr(scene, name)[at:]])
        for name in GAUSSIANS
    }
    more = replace(scene, **joined)
    radii = hqgs.rasterization(**more.arguments(**options))[2]["radii"][0, at]
    assert radii.tolist() == [0, 0]
    for a, b in zip(picture(scene, **options), picture(more, **options), strict=True):
        assert torch.equal(a, b)
    before, after = gradients(scene, **options), gradients(more, **options)
    rest = [i for i in range(len(more.means)) if i != at]
    for name in INPUTS:
        if name == "viewmats":  # sums over the Gaussians, whose grouping follows from their number
            rounding = 1e-4 if scene.means.dtype == F32 else 1e-10
            error = (after[name] - before[name]).norm() / before[name].norm().clamp(min=1e-30)
            assert error < rounding
            continue
        others = after[name][rest] if name in GAUSSIANS else after[name]
        assert torch.equal(others, before[name]), name
        assert name not in GAUSSIANS or not after[name][at].any(), name


def _product(a: Tensor, b: Tensor) -> Tensor:
    """The quaternion a [4] times each b [N, 4]."""
    w, v = b[:, :1], b[:, 1:]
    real = a[0] * w - v @ a[1:, None]
    cross = torch.linalg.cross(a[1:].expand_as(v), v)
    return torch.cat([real, a[0] * v + w * a[1:] + cross], dim=1)


@always_the_same
@given(scenes((F64,)), modes(), st.integers(0, 2**32 - 1))
def test_moving_world_and_cameras_together_changes_only_the_rounding(
    scene: GaussianScene, options: dict[str, Any], seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    q = torch.randn(4, generator=generator, dtype=F64)
    R, t = rotation_matrices(q[None])[0], torch.randn(3, generator=generator, dtype=F64)
    back = torch.eye(4, dtype=F64)
    back[:3, :3], back[:3, 3] = R.T, -R.T @ t
    moved = replace(
        scene,
        means=scene.means @ R.T + t,
        quats=_product(q / q.norm(), scene.quats),
        viewmats=scene.viewmats @ back,
    )
    for a, b in zip(picture(scene, **options), picture(moved, **options), strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-8)


@always_the_same
@given(scenes(), modes(), st.floats(-3, 3, width=32), st.floats(-3, 3, width=32))
def test_the_picture_is_linear_in_the_colours(
    scene: GaussianScene, options: dict[str, Any], a: float, b: float
) -> None:
    generator = torch.Generator().manual_seed(1)
    other = replace(
        scene,
        colors=torch.randn(scene.colors.shape, generator=generator, dtype=F64).to(scene.colors.dtype),
        backgrounds=torch.randn(scene.backgrounds.shape, generator=generator, dtype=F64).to(
            scene.colors.dtype
        ),
    )
    mixed = replace(
        scene,
        colors=a * scene.colors + b * other.colors,
        backgrounds=a * scene.backgrounds + b * other.backgrounds,
    )
    expected = a * picture(scene, **options)[0] + b * picture(other, **options)[0]
    atol = 1e-4 if scene.means.dtype == F32 else 1e-12
    torch.testing.assert_close(picture(mixed, **options)[0], expected, rtol=0.0, atol=atol)


def _scaled(scene: GaussianScene, factor: float) -> GaussianScene:
    viewmats = scene.viewmats.clone()
    viewmats[:, :3, 3] *= factor
    return replace(scene, means=scene.means * factor, scales=scene.scales * factor, viewmats=viewmats)


@always_the_same
@given(scenes(), modes(), st.integers(-20, 20), st.floats(1e-3, 1e3))
def test_the_unit_of_the_world_does_not_matter(
    scene: GaussianScene, options: dict[str, Any], power: int, factor: float
) -> None:
    near, far = 0.5, 100.0
    before = picture(scene, near_plane=near, far_plane=far, **options)
    twos = 2.0**power  # exact in any format
    after = picture(_scaled(scene, twos), near_plane=near * twos, far_plane=far * twos, **options)
    for a, b in zip(before, after, strict=True):
        assert torch.equal(a, b)
    if scene.means.dtype == F64:
        after = picture(_scaled(scene, factor), near_plane=near * factor, far_plane=far * factor, **options)
        for a, b in zip(before, after, strict=True):
            torch.testing.assert_close(a, b, rtol=0.0, atol=1e-8)


@settings(always_the_same, max_examples=150)
@given(st.data(), scenes((F32,)), modes())
def test_finite_input_gives_finite_output_and_gradients(
    data: st.DataObject, scene: GaussianScene, options: dict[str, Any]
) -> None:
    changed = {name: getattr(scene, name).clone() for name in GAUSSIANS}
    for _ in range(data.draw(st.integers(1, 6))):
        name = data.draw(st.sampled_from(GAUSSIANS))
        flat = changed[name].view(-1)
        value = data.draw(st.sampled_from(EXTREMES)) * data.draw(st.sampled_from([1.0, -1.0]))
        if name == "colors":
            value = min(max(value, -1e18), 1e18)  # sums of larger ones overflow by right
        flat[data.draw(st.integers(0, len(flat) - 1))] = value
    extreme = replace(scene, **changed)
    for result in (*picture(extreme, **options), *gradients(extreme, **options).values()):
        assert torch.isfinite(result).all()
