"""Images of `hqgs.rasterization` against the float64 reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from reference import reference_rasterization, safe_pixels
from scenes import GaussianScene, random_scene
from torch import Tensor

import hqgs

F32, F64 = torch.float32, torch.float64
TOLERANCE = {F64: 1e-9, F32: 2e-5}  # largest error, for values of order 1
both_dtypes = pytest.mark.parametrize("dtype", [F64, F32], ids=["f64", "f32"])


def assert_images_agree(scene: GaussianScene, unsafe_share: float = 0.01, **options: Any) -> Tensor:
    """Compare render and alphas wherever no pixel sits on a jump; returns the alphas [C, H, W, 1].

    The pixels on a jump are few, and there one decision moves a color by at most 0.01 or so.
    """
    arguments = scene.arguments(**options)
    dtype = scene.means.dtype
    render, alphas, _ = hqgs.rasterization(**arguments)
    expected, expected_alphas, meta = reference_rasterization(**arguments)
    assert render.shape == expected.shape
    assert alphas.shape == expected_alphas.shape
    assert render.dtype == alphas.dtype == dtype
    safe = safe_pixels(meta, dtype)
    assert 1 - safe.double().mean().item() <= unsafe_share
    mode = options.get("render_mode", "RGB")
    for channel in range(expected.shape[-1]):
        scale = max(1.0, expected[..., channel].abs().max().item())
        errors = (render[..., channel] - expected[..., channel]).abs() / scale
        assert errors[safe].max().item() <= TOLERANCE[dtype], f"channel {channel}"
        if mode == "RGB":
            assert errors.max().item() <= 0.02, f"channel {channel}"
    errors = (alphas - expected_alphas).abs()[..., 0]
    assert errors[safe].max().item() <= TOLERANCE[dtype]
    assert errors.max().item() <= 0.02
    return alphas


@both_dtypes
@pytest.mark.parametrize(
    ("n", "width", "height", "seed"),
    [
        (300, 50, 37, 0),
        (300, 33, 17, 1),
        (400, 101, 67, 2),
        (60, 16, 16, 3),
        (100, 7, 90, 4),
        (40, 1, 1, 5),
        (1500, 45, 31, 6),
    ],
)
def test_sizes_and_seeds(n: int, width: int, height: int, seed: int, dtype: torch.dtype) -> None:
    scene = random_scene(n, width, height, seed=seed, dtype=dtype)
    alphas = assert_images_agree(scene, unsafe_share=0.02)
    assert alphas.max() > 0.5


def test_the_dense_scene_stops_early() -> None:
    """The scene above does reach the transmittance stop, nearly everywhere."""
    scene = random_scene(1500, 45, 31, seed=6)
    alphas = reference_rasterization(**scene.arguments())[1]
    assert (alphas > 0.99).double().mean() > 0.5


@both_dtypes
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_modes(render_mode: str, rasterize_mode: str, dtype: torch.dtype) -> None:
    scene = random_scene(120, 40, 27, cameras=2, seed=10, dtype=dtype)
    assert_images_agree(scene, render_mode=render_mode, rasterize_mode=rasterize_mode)


@both_dtypes
@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 7, 32, 40])
def test_channels_and_backgrounds(channels: int, background: bool, dtype: torch.dtype) -> None:
    scene = random_scene(100, 30, 21, seed=channels, dtype=dtype, channels=channels)
    assert_images_agree(scene, backgrounds=scene.backgrounds if background else None)


@both_dtypes
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_spherical_harmonics(sh_degree: int, dtype: torch.dtype) -> None:
    """`colors` holds a degree more than is active; two cameras see each Gaussian from two directions."""
    scene = random_scene(100, 30, 21, cameras=2, seed=20, dtype=dtype, sh_degree=sh_degree)
    assert scene.colors.shape[-2] >= (sh_degree + 1) ** 2
    assert_images_agree(scene)


@both_dtypes
@pytest.mark.parametrize("cameras", [1, 2, 3])
@pytest.mark.parametrize("per_camera_colors", [False, True])
def test_cameras(cameras: int, per_camera_colors: bool, dtype: torch.dtype) -> None:
    scene = random_scene(
        150, 37, 26, cameras, seed=30, dtype=dtype, per_camera_colors=per_camera_colors, channels=2
    )
    assert_images_agree(scene, render_mode="RGB+D")


@both_dtypes
@pytest.mark.parametrize(
    "options",
    [
        {"near_plane": 3.0},
        {"far_plane": 5.0},
        {"radius_clip": 3.0},
        {"eps2d": 0.0},
        {"eps2d": 1.5, "rasterize_mode": "antialiased"},
    ],
    ids=str,
)
def test_options(options: dict[str, Any], dtype: torch.dtype) -> None:
    scene = random_scene(150, 37, 26, seed=40, dtype=dtype, anisotropy=10.0)
    default = reference_rasterization(**scene.arguments())[0]
    changed = reference_rasterization(**scene.arguments(**options))[0]
    assert (default - changed).abs().max() > 0.01
    assert_images_agree(scene, **options)


@both_dtypes
def test_support_after_an_opacity_reset(dtype: torch.dtype) -> None:
    """At opacity 0.01 a Gaussian still reaches out to sqrt(2 ln 2.55) = 1.37 standard deviations."""
    scene = random_scene(400, 50, 37, seed=50, dtype=dtype, opacity=(0.01, 0.01))
    assert assert_images_agree(scene, unsafe_share=0.02).max() > 0.05


@both_dtypes
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_meta(rasterize_mode: str, dtype: torch.dtype) -> None:
    scene = random_scene(400, 50, 37, cameras=3, seed=60, dtype=dtype)
    meta = hqgs.rasterization(**scene.arguments(), rasterize_mode=rasterize_mode)[2]
    expected = reference_rasterization(**scene.arguments(), rasterize_mode=rasterize_mode)[2]
    assert meta["radii"].shape == (3, 400, 2)
    assert meta["radii"].dtype == torch.int32

    # Extents within 1e-4 of an integer may round either way. A box that stays outside of the image by less
    # than a pixel may count as seen, for rounded radii reach the image.
    visible = (expected["radii"] > 0).all(-1)
    near_integer = ((expected["extents"] - expected["extents"].round()).abs() < 1e-4).any(-1)
    at_border = (
        (expected["overlaps"] > -1) & (expected["overlaps"] < 1e-3) & (expected["extents"] > 0).any(-1)
    )
    sure = ~at_border & ~(visible & near_integer)
    assert sure.double().mean() > 0.95
    assert torch.equal(meta["radii"][sure], expected["radii"][sure])
    off_screen = sure & (expected["extents"] > 0).any(-1) & ~visible
    behind = sure & ~visible & ~off_screen
    assert min(visible.sum(), off_screen.sum(), behind.sum()) > 20

    shown = visible & sure
    tolerance = TOLERANCE[dtype]
    for name in ("means2d", "depths", "conics", "opacities"):
        actual, wanted = meta[name], expected[name]
        assert actual.dtype == dtype
        assert actual.shape == wanted.shape
        errors, scale = (actual - wanted)[shown].abs(), wanted[shown].abs()
        if errors.dim() == 2:  # relative to the largest entry of the Gaussian
            errors, scale = errors.amax(1), scale.amax(1)
        assert (errors / scale).max().item() <= tolerance, name


@both_dtypes
def test_ties_in_depth_follow_the_index(dtype: torch.dtype) -> None:
    """Eight planes of Gaussians share three depths; a permutation of the indices changes the image."""
    n = 48
    scene = random_scene(n, 40, 30, seed=70, dtype=dtype, hidden=0.0, channels=4)
    means = torch.randn(n, 3, generator=torch.Generator().manual_seed(1))
    means[:, 2] = torch.tensor([2.0, 3.0, 4.0])[torch.arange(n) % 3]
    scene = replace(
        scene,
        means=means.to(dtype),
        scales=torch.full((n, 3), 0.3, dtype=dtype),
        viewmats=torch.eye(4, dtype=dtype)[None],
    )
    images = []
    for order in (torch.arange(n), torch.arange(n).flip(0)):
        tied = scene.pick(order)
        render = hqgs.rasterization(**tied.arguments())[0]
        expected, _, meta = reference_rasterization(**tied.arguments())
        safe = meta["min_margin"] > 1e-4
        assert safe.double().mean() > 0.98
        assert (render - expected).abs()[safe].max().item() <= TOLERANCE[dtype]
        images.append(expected)
    assert (images[0] - images[1]).abs().max() > 0.1
