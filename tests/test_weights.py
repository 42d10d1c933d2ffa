"""The largest blending weights, against the dense reference: its image of N one-hot channels holds them."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from reference import reference_rasterization, safe_pixels
from scenes import random_scene
from torch import Tensor

import hqgs
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import blending_weights, largest_weights
from hqgs.scene.scene import Camera, View

WIDTH, HEIGHT = 45, 37  # no multiples of a tile
N = 120


def make_scene(dtype: torch.dtype, seed: int = 0, cameras: int = 1) -> tuple[Gaussians, list[Camera]]:
    """A mixture of which a part is behind the camera, off the screen or too transparent."""
    scene = random_scene(N, WIDTH, HEIGHT, cameras=cameras, seed=seed, largest=0.3)
    gaussians = Gaussians(
        means=scene.means.to(dtype),
        scales=scene.scales.log().to(dtype),
        quats=scene.quats.to(dtype),
        opacities=scene.opacities.logit().to(dtype),
        sh0=torch.zeros(N, 1, 3, dtype=dtype),
        shN=torch.zeros(N, 0, 3, dtype=dtype),
    )
    views = zip(scene.Ks.numpy(), scene.viewmats.numpy(), strict=True)
    return gaussians, [Camera(WIDTH, HEIGHT, K, viewmat) for K, viewmat in views]


def reference_weights(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, dict[str, Any]]:
    """Weights [H, W, N] in float64, and the margins of every decision."""
    with torch.no_grad():
        image, _, meta = reference_rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.activated_scales(),
            gaussians.activated_opacities(),
            torch.eye(len(gaussians), dtype=torch.float64),
            torch.from_numpy(camera.viewmat[None]),
            torch.from_numpy(camera.K[None]),
            camera.width,
            camera.height,
        )
    return image[0], meta


@cache
def case(dtype: torch.dtype, seed: int) -> tuple[Gaussians, Camera, Tensor, Tensor]:
    """Gaussians, camera, weights [H, W, N], and the pixels in which rounding decides nothing."""
    gaussians, (camera,) = make_scene(dtype, seed)
    weights, meta = reference_weights(gaussians, camera)
    return gaussians, camera, weights, safe_pixels(meta, dtype)[0]


def masked(weights: Tensor, mask: Tensor) -> Tensor:
    return torch.where(mask[..., None], weights, 0.0).amax((0, 1))


def view(camera: Camera, mask: Tensor | None) -> View:
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    return View("v", camera, image, None if mask is None else mask.numpy())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_weights_are_those_of_the_reference(dtype: torch.dtype, tolerance: float, seed: int) -> None:
    gaussians, camera, weights, safe = case(dtype, seed)
    assert safe.float().mean() > 0.9
    half = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    half[5:, :20] = True  # ends inside of tiles and of blocks
    scattered = torch.from_numpy(np.random.default_rng(seed).random((HEIGHT, WIDTH)) < 0.3)
    seen = []
    for mask in (safe, safe & half, safe & scattered):
        got, expected = largest_weights(gaussians, [view(camera, mask)]), masked(weights, mask)
        assert got.dtype == dtype
        torch.testing.assert_close(got.double(), expected, rtol=0, atol=tolerance)
        assert torch.equal(got == 0, expected == 0)
        seen.append(int((got > 0).sum()))
    assert 20 < seen[1] < seen[0] < N  # some are hidden, culled or off the screen
    if safe.all():
        whole = blending_weights(gaussians, camera)
        torch.testing.assert_close(whole.double(), weights.amax((0, 1)), rtol=0, atol=tolerance)


def test_some_scene_is_compared_in_all_of_its_pixels() -> None:
    assert any(case(torch.float64, seed)[3].all() for seed in range(3))


def test_no_mask_and_a_mask_of_all_pixels_are_the_same() -> None:
    gaussians, (camera,) = make_scene(torch.float32)
    whole = blending_weights(gaussians, camera)
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    assert torch.equal(largest_weights(gaussians, [view(camera, everywhere)]), whole)
    assert torch.equal(largest_weights(gaussians, [view(camera, None)]), whole)
    assert not largest_weights(gaussians, [view(camera, ~everywhere)]).any()


def test_the_maximum_over_views() -> None:
    gaussians, cameras = make_scene(torch.float32, cameras=3)
    each = torch.stack([blending_weights(gaussians, camera) for camera in cameras])
    together = largest_weights(gaussians, [view(camera, None) for camera in cameras])
    assert torch.equal(together, each.amax(0))
    assert len(set(each.argmax(0).tolist())) == 3
    assert not largest_weights(gaussians, []).any()


def test_same_bits_for_any_number_of_threads() -> None:
    gaussians, (camera,) = make_scene(torch.float32)
    before, results = hqgs.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            hqgs.set_num_threads(threads)
            results.append(blending_weights(gaussians, camera).numpy().tobytes())
    finally:
        hqgs.set_num_threads(before)
    assert results[0] == results[1] == results[2]


def stack(opacities: list[float], z: float = 3.0) -> tuple[Gaussians, Camera]:
    """Large discs one behind the other: each has its full opacity in the middle of the pixel (2, 2)."""
    n = len(opacities)
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, z + 0.1 * i] for i in range(n)], dtype=torch.float64).reshape(n, 3),
        scales=torch.full((n, 3), 2.0, dtype=torch.float64),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1),
        opacities=torch.tensor(opacities, dtype=torch.float64).logit(),
        sh0=torch.zeros(n, 1, 3, dtype=torch.float64),
        shN=torch.zeros(n, 0, 3, dtype=torch.float64),
    )
    return gaussians, Camera(5, 5, np.array([[5.0, 0.0, 2.5], [0.0, 5.0, 2.5], [0.0, 0.0, 1.0]]), np.eye(4))


def test_nothing_is_blended_behind_the_stop() -> None:
    gaussians, camera = stack([0.999, 0.9899, 0.5, 0.01])
    middle = torch.zeros(5, 5, dtype=torch.bool)
    middle[2, 2] = True
    # 0.999 is capped at 0.99; the third layer would leave 0.5e-4, less than the stop, and ends the pixel.
    weights = largest_weights(gaussians, [view(camera, middle)]).tolist()
    assert weights[:2] == pytest.approx([0.99, 0.01 * 0.9899], rel=1e-9)
    assert weights[2:] == [0.0, 0.0]


def test_no_gaussians_and_none_in_sight() -> None:
    empty, camera = stack([])
    assert blending_weights(empty, camera).shape == (0,)
    behind, camera = stack([0.5] * 20, z=-9.0)
    assert blending_weights(behind, camera).tolist() == [0.0] * 20


def test_there_is_no_gradient_history() -> None:
    gaussians, (camera,) = make_scene(torch.float32)
    for tensor in gaussians.named().values():
        tensor.requires_grad_()
    assert not blending_weights(gaussians, camera).requires_grad


def test_a_mask_of_another_size_is_refused() -> None:
    gaussians, (camera,) = make_scene(torch.float32)
    with pytest.raises(ValueError, match=r"mask: expected shape \[1, 37, 45\], got \[1, 45, 37\]"):
        largest_weights(gaussians, [view(camera, torch.ones(WIDTH, HEIGHT, dtype=torch.bool))])
