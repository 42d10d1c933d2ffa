"""Gradients of `hqgs.rasterization`: finite differences, the reference's autograd, and repeatability."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from reference import reference_rasterization, safe_pixels
from scenes import GaussianScene, random_scene
from torch import Tensor

import hqgs

F32, F64 = torch.float32, torch.float64
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
TOLERANCE = {F64: 1e-9, F32: 1e-4}  # relative L2
both_dtypes = pytest.mark.parametrize("dtype", [F64, F32], ids=["f64", "f32"])
Renderer = Callable[..., tuple[Tensor, Tensor, Mapping[str, Any]]]


def smooth_scene(options: dict[str, Any], **scene_options: Any) -> GaussianScene:
    """The first of the seeds 0, 1, ... whose 8 x 6 image of five Gaussians is smooth in all its pixels.

    Smooth: no alpha within 1e-4 (relative) of the floor or the cap, no T of the stop, no two depths of each
    other, while finite differences step by about 1e-6. Four Gaussians at least are seen.
    """
    for seed in itertools.count():
        scene = random_scene(5, 8, 6, seed=seed, hidden=0.0, anisotropy=10.0, **scene_options)
        meta = reference_rasterization(**scene.arguments(**options))[2]
        margins = torch.stack([meta[name] for name in ("min_margin", "cap_margin", "order_margin")])
        if margins.min() > 1e-4 and (meta["radii"] > 0).all(-1).sum(1).min() >= 4:
            return scene
    raise AssertionError


GRADCHECK_CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "classic": ({}, {}),
    "antialiased-RGB+ED": ({"rasterize_mode": "antialiased", "render_mode": "RGB+ED"}, {"channels": 2}),
    "SH-2-two-cameras": ({}, {"sh_degree": 2, "cameras": 2}),
    "SH-3-RGB+D": ({"render_mode": "RGB+D"}, {"sh_degree": 3}),
}


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("case", GRADCHECK_CASES)
def test_gradcheck(case: str, name: str) -> None:
    """The whole Jacobian of render and alphas against central differences, one input at a time."""
    options, scene_options = GRADCHECK_CASES[case]
    scene = smooth_scene(options, **scene_options).with_grad(name)

    def render(value: Tensor) -> tuple[Tensor, Tensor]:
        if name == "viewmats":  # the last row is (0, 0, 0, 1), not a variable
            value = torch.cat([value, scene.viewmats[:, 3:].detach()], dim=1)
        return hqgs.rasterization(**scene.arguments(**{name: value}, **options))[:2]

    variable = getattr(scene, name)
    if name == "viewmats":
        variable = variable[:, :3].detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(render, variable, eps=1e-6, atol=1e-6, rtol=1e-5)


def run(
    renderer: Renderer, scene: GaussianScene, cotangents: tuple[Tensor, Tensor], **options: Any
) -> tuple[dict[str, Tensor], Mapping[str, Any]]:
    """Gradients of <render, cotangents[0]> + <alphas, cotangents[1]> for the scene's leaves, and meta."""
    render, alphas, meta = renderer(**scene.arguments(**options))
    if meta["means2d"].requires_grad:
        meta["means2d"].retain_grad()
    ((render * cotangents[0].to(render)).sum() + (alphas * cotangents[1].to(alphas)).sum()).backward()
    gradients = {name: tensor.grad for name, tensor in scene.tensors().items() if tensor.grad is not None}
    if meta["means2d"].grad is not None:
        gradients["means2d"] = meta["means2d"].grad
    return gradients, meta


def cotangents_for(scene: GaussianScene, safe: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
    """Random cotangents of render and alphas, 0 where a pixel is not `safe` [C, H, W]."""
    generator = torch.Generator().manual_seed(7)
    mode = options.get("render_mode", "RGB")
    channels = (scene.backgrounds.shape[1] if mode.startswith("RGB") else 0) + mode.endswith("D")
    render = torch.randn(*safe.shape, channels, generator=generator, dtype=F64)
    alphas = torch.randn(*safe.shape, 1, generator=generator, dtype=F64)
    return render * safe[..., None], alphas * safe[..., None]


def assert_gradients_agree(scene: GaussianScene, **options: Any) -> None:
    """Every input's gradient, and that of means2d, as a vector against the reference's."""
    dtype = scene.means.dtype
    wanted_scene, scene = scene.to(F64).with_grad(*INPUTS), scene.with_grad(*INPUTS)
    meta = reference_rasterization(**scene.with_grad().arguments(**options))[2]
    safe = safe_pixels(meta, dtype, smooth=True)
    assert safe.double().mean() > 0.98
    cotangents = cotangents_for(scene, safe, **options)
    wanted, wanted_meta = run(reference_rasterization, wanted_scene, cotangents, **options)
    actual, actual_meta = run(hqgs.rasterization, scene, cotangents, **options)
    if options.get("absgrad"):
        wanted["absgrad"], actual["absgrad"] = wanted_meta["means2d"].absgrad, actual_meta["means2d"].absgrad
        assert (actual["absgrad"] >= actual["means2d"].abs() * (1 - 1e-5)).all()
    for name in set(actual) - set(wanted):  # a depth image does not depend on colors and backgrounds
        assert options["render_mode"] == "D"
        assert (actual[name] == 0).all(), name
    for name, expected in wanted.items():
        gradient = actual[name]
        assert gradient.dtype == dtype
        assert gradient.shape == expected.shape
        a, b = gradient.double().flatten(), expected.flatten()
        assert b.norm() > 0
        assert ((a - b).norm() / b.norm()).item() <= TOLERANCE[dtype], name
        assert (torch.dot(a, b) / (a.norm() * b.norm())).item() >= 0.9999, name


@both_dtypes
@pytest.mark.parametrize("seed", [0, 1])
def test_agreement_on_500_gaussians(seed: int, dtype: torch.dtype) -> None:
    assert_gradients_agree(random_scene(500, 101, 67, seed=seed, dtype=dtype))


@both_dtypes
@pytest.mark.parametrize(
    ("options", "scene_options"),
    [
        ({"rasterize_mode": "antialiased", "render_mode": "RGB+D"}, {"cameras": 2}),
        ({"render_mode": "D", "absgrad": True}, {}),
        ({"render_mode": "RGB+ED"}, {"channels": 1}),
        ({"absgrad": True}, {"sh_degree": 3, "cameras": 3}),
        ({"rasterize_mode": "antialiased"}, {"sh_degree": 1}),
        ({}, {"channels": 7, "cameras": 2, "per_camera_colors": True}),
        ({}, {"channels": 40}),
        ({}, {"opacity": (0.01, 0.01)}),
    ],
    ids=lambda options: "-".join(f"{k}={v}" for k, v in options.items()) or "default",
)
def test_agreement(options: dict[str, Any], scene_options: dict[str, Any], dtype: torch.dtype) -> None:
    assert_gradients_agree(random_scene(150, 40, 27, seed=5, dtype=dtype, **scene_options), **options)


def random_cotangents(scene: GaussianScene, **options: Any) -> tuple[Tensor, Tensor]:
    """Random cotangents everywhere, for comparisons of the rasterizer with itself."""
    everywhere = torch.ones(len(scene.Ks), scene.height, scene.width, dtype=torch.bool)
    return cotangents_for(scene, everywhere, **options)


@both_dtypes
def test_any_number_of_threads_gives_the_same_bits(dtype: torch.dtype) -> None:
    scene = random_scene(3000, 150, 110, cameras=2, seed=9, dtype=dtype, sh_degree=2)
    cotangents = random_cotangents(scene, render_mode="RGB+ED")
    results = []
    for threads in (1, 2, 3, 8, 1):
        hqgs.set_num_threads(threads)
        assert hqgs.get_num_threads() == threads
        leaves = scene.with_grad(*INPUTS)
        render, alphas, _ = hqgs.rasterization(**leaves.arguments(), render_mode="RGB+ED")
        gradients, meta = run(hqgs.rasterization, leaves, cotangents, render_mode="RGB+ED", absgrad=True)
        results.append({"render": render, "alphas": alphas, "absgrad": meta["means2d"].absgrad, **gradients})
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value, other[name]), name


@pytest.mark.parametrize(
    "names",
    [(name,) for name in INPUTS] + [("means", "colors"), ("quats", "scales", "viewmats")],
    ids="-".join,
)
def test_each_subset_of_inputs_gets_its_own_gradient(names: tuple[str, ...]) -> None:
    scene = random_scene(80, 30, 21, cameras=2, seed=3, sh_degree=1)
    cotangents = random_cotangents(scene)
    everything, _ = run(hqgs.rasterization, scene.with_grad(*INPUTS), cotangents)
    some, _ = run(hqgs.rasterization, scene.with_grad(*names), cotangents)
    assert set(some) - {"means2d"} == set(names)
    for name in names:
        assert torch.equal(some[name], everything[name]), name


def test_one_cotangent_is_enough() -> None:
    """A loss on the render alone, or on the alphas alone, is a loss whose other cotangent is 0."""
    scene = random_scene(80, 30, 21, seed=4)
    cotangents = random_cotangents(scene)
    for kept in (0, 1):
        pair = (cotangents[0] * (kept == 0), cotangents[1] * (kept == 1))
        expected, _ = run(hqgs.rasterization, scene.with_grad("means", "opacities"), pair)
        leaves = scene.with_grad("means", "opacities")
        outputs = hqgs.rasterization(**leaves.arguments())[:2]
        (outputs[kept] * cotangents[kept]).sum().backward()
        for name in ("means", "opacities"):
            assert torch.equal(getattr(leaves, name).grad, expected[name]), name


def test_absgrad_is_the_sum_of_absolute_pixel_gradients() -> None:
    """One backward per pixel, each through the reference; then the absolute values are summed."""
    scene = random_scene(12, 9, 7, seed=3, hidden=0.0)
    meta = reference_rasterization(**scene.arguments())[2]
    cotangents = cotangents_for(scene, safe_pixels(meta, F64, smooth=True))
    actual, actual_meta = run(hqgs.rasterization, scene.with_grad("means"), cotangents, absgrad=True)
    render, alphas, meta = reference_rasterization(**scene.with_grad("means").arguments())
    products = (render * cotangents[0]).sum(-1) + (alphas * cotangents[1]).sum(-1)  # [1, H, W]
    expected = torch.zeros(1, 12, 2, dtype=F64)
    for value in products.flatten():
        expected += torch.autograd.grad(value, meta["means2d"], retain_graph=True)[0].abs()
    absgrad = actual_meta["means2d"].absgrad
    assert absgrad.shape == expected.shape
    assert ((absgrad - expected).norm() / expected.norm()).item() <= 1e-9
    assert (absgrad >= actual["means2d"].abs() * (1 - 1e-12)).all()
    assert (absgrad > 1.5 * actual["means2d"].abs()).any()


def test_absgrad_changes_nothing_else() -> None:
    scene = random_scene(80, 30, 21, seed=6)
    cotangents = random_cotangents(scene)
    plain, _ = run(hqgs.rasterization, scene.with_grad(*INPUTS), cotangents)
    with_absgrad, _ = run(hqgs.rasterization, scene.with_grad(*INPUTS), cotangents, absgrad=True)
    for name, gradient in plain.items():
        assert torch.equal(gradient, with_absgrad[name]), name


def test_a_capped_alpha_has_no_gradient() -> None:
    """Opacity 0.999 over a pixel far inside the Gaussian: alpha is 0.99 there whatever the inputs do."""
    scene = random_scene(1, 40, 30, seed=0, hidden=0.0)
    scene = replace(
        scene,
        means=torch.tensor([[0.0, 0.0, 2.0]], dtype=F64),
        scales=torch.full((1, 3), 50.0, dtype=F64),
        opacities=torch.tensor([0.999], dtype=F64),
        viewmats=torch.eye(4, dtype=F64)[None],
    ).with_grad(*INPUTS)
    render, alphas, _ = hqgs.rasterization(**scene.arguments())
    assert alphas[0, 15, 20].item() == pytest.approx(0.99, abs=1e-15)
    (render[0, 15, 20].sum() + alphas[0, 15, 20].sum()).backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert (getattr(scene, name).grad == 0).all(), name
    assert scene.colors.grad is not None
    assert scene.colors.grad[0].tolist() == pytest.approx([0.99] * 3)


def test_no_grad() -> None:
    scene = random_scene(50, 20, 15, seed=7).with_grad(*INPUTS)
    expected, expected_alphas, _ = hqgs.rasterization(**scene.arguments())
    assert expected.requires_grad
    with torch.no_grad():
        render, alphas, meta = hqgs.rasterization(**scene.arguments(), absgrad=True)
    assert not render.requires_grad
    assert not meta["means2d"].requires_grad
    assert torch.equal(render, expected)
    assert torch.equal(alphas, expected_alphas)


@both_dtypes
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_harmonics_in_two_tensors_are_those_in_one(sh_degree: int, dtype: torch.dtype) -> None:
    scene = random_scene(60, 33, 21, seed=4, dtype=dtype, sh_degree=sh_degree)
    one, two = scene.with_grad("means"), scene.with_grad("means")
    bands = (sh_degree + 1) ** 2  # at degree 0 the second tensor is empty
    joined = scene.colors[:, :bands].clone().requires_grad_()
    first = scene.colors[:, :1].clone().requires_grad_()
    rest = scene.colors[:, 1:bands].clone().requires_grad_()
    expected, _, _ = hqgs.rasterization(**one.arguments(colors=joined))
    render, _, _ = hqgs.rasterization(**two.arguments(colors=(first, rest)))
    assert torch.equal(render, expected)
    weights = torch.rand(render.shape, dtype=dtype, generator=torch.Generator().manual_seed(0))
    (expected * weights).sum().backward()
    (render * weights).sum().backward()
    assert joined.grad is not None
    assert first.grad is not None
    assert rest.grad is not None
    assert torch.equal(torch.cat([first.grad, rest.grad], dim=1), joined.grad)
    assert one.means.grad is not None
    assert one.means.grad.abs().sum() > 0
    assert two.means.grad is not None
    assert torch.equal(one.means.grad, two.means.grad)


@pytest.mark.parametrize("antialiased", [False, True])
@both_dtypes
def test_logarithms_and_logits_are_activated(dtype: torch.dtype, antialiased: bool) -> None:
    scene = random_scene(200, 60, 45, seed=6, dtype=dtype, sh_degree=1).with_grad("means", "colors")
    others: dict[str, Any] = {"rasterize_mode": "antialiased" if antialiased else "classic"}
    raw = {"scales": scene.scales.log(), "opacities": scene.opacities.logit()}
    weights = torch.rand(1, 45, 60, 3, dtype=dtype, generator=torch.Generator().manual_seed(1))

    def gradients(activate: bool) -> tuple[Tensor, ...]:
        given = {name: tensor.detach().clone().requires_grad_() for name, tensor in raw.items()}
        seen = (
            given
            if activate
            else {"scales": given["scales"].exp(), "opacities": given["opacities"].sigmoid()}
        )
        image, _, _ = hqgs.rasterization(**scene.arguments(**seen, **others), activate=activate)
        leaves = (*given.values(), scene.means, scene.colors)
        return image, *torch.autograd.grad((image * weights).sum(), leaves)

    for found, expected in zip(gradients(True), gradients(False), strict=True):
        assert (found - expected).norm() < TOLERANCE[dtype] * expected.norm()


def test_covariances_have_no_logarithm() -> None:
    scene = random_scene(3, 8, 6)
    covars = torch.eye(3, dtype=F64).expand(3, 3, 3)
    with pytest.raises(ValueError, match="activate: not with covars"):
        hqgs.rasterization(**scene.arguments(covars=covars), activate=True)


def test_a_graph_is_freed_by_its_backward_pass_as_torch_frees_its_own() -> None:
    """Also of colours alone, where torch has no tensor to miss."""
    scene = random_scene(60, 24, 17, seed=1, dtype=F64).with_grad("colors")
    loss = hqgs.rasterization(**scene.arguments())[0].square().sum()
    loss.backward(retain_graph=True)
    once = scene.colors.grad.clone()  # pyright: ignore
    loss.backward()
    assert torch.equal(scene.colors.grad, 2 * once)  # pyright: ignore
    with pytest.raises(RuntimeError, match="a second time"):
        loss.backward()


def test_backgrounds_may_change_before_the_backward_pass() -> None:
    found = []
    for later in (False, True):
        scene, behind = (
            random_scene(60, 24, 17, seed=1, dtype=F64).with_grad("opacities"),
            torch.ones(1, 3, dtype=F64),
        )
        image = hqgs.rasterization(**scene.arguments(backgrounds=behind))[0]
        if later:
            behind.zero_()
        image.square().sum().backward()
        found.append(scene.opacities.grad)
    assert torch.equal(*found)  # pyright: ignore
