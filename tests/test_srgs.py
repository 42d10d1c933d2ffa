"""SRGS: its downsampling and loss against numpy and torch, its ties and masks, its gain over 3DGS."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from example_method import install, loss_of
from numpy.typing import NDArray
from run_state import run_until
from scipy.ndimage import correlate1d
from tiny_scene import tiny_config, tiny_scene

from hqgs.evaluation.metrics import psnr
from hqgs.photos.formation import Separable
from hqgs.photos.resize import resize, resize_matrix
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import DensifyConfig, SRGSConfig
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.methods.srgs import SRGS
from hqgs.training.trainer import Trainer

FACTOR = 4


def fine_texture(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
    """Waves of 10 to 12 px in `fine_scene`; the shortest that its photos can show has 8 px."""
    waves = [np.sin(6 * x), np.cos(5.4 * y), np.sin(4.2 * x + 3.6 * y)]
    return (0.5 + 0.4 * np.stack(waves, axis=-1)).astype(np.float32)


def fine_scene(views: int = 12, points: int = 800) -> tuple[Scene, list[NDArray[np.float32]]]:
    """Low-resolution photos, enlarged, of a textured plane, and the clean photos."""
    width, height, depth = 48, 32, 3.0
    K = np.array([[30.0, 0.0, width / 2], [0.0, 30.0, height / 2], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[:height, :width] + 0.5
    rng = np.random.default_rng(3)
    photos, clean = [], []
    for i in range(views):
        shift = np.array([*rng.uniform(-0.4, 0.4, 2), 0.0])
        viewmat = np.eye(4)
        viewmat[:3, 3] = -shift
        x = shift[0] + depth * (columns - K[0, 2]) / K[0, 0]
        y = shift[1] + depth * (rows - K[1, 2]) / K[1, 1]
        clean.append(fine_texture(x, y))
        low = resize(clean[-1], height // FACTOR, width // FACTOR)
        photos.append(View(f"{i}", Camera(width, height, K, viewmat), resize(low, height, width), low=low))
    xy = rng.uniform([-2.8, -2.0], [2.8, 2.0], (points, 2))
    xyz = np.concatenate([xy, np.full((points, 1), depth)], axis=1).astype(np.float32)
    colors = np.full((points, 3), 128, np.uint8)
    return Scene("fine", photos, [], xyz, colors, "test"), clean


def photometric_numpy(x: NDArray[Any], y: NDArray[Any]) -> float:
    """0.8 L1 + 0.2 (1 - SSIM) from the definitions, zeros beyond the border."""
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def mean(image: NDArray[Any]) -> NDArray[Any]:
        for axis in (0, 1):
            image = correlate1d(image, taps, axis, mode="constant")
        return image

    mu_x, mu_y = mean(x), mean(y)
    var_x, var_y, cov = mean(x * x) - mu_x**2, mean(y * y) - mu_y**2, mean(x * y) - mu_x * mu_y
    ssim = (2 * mu_x * mu_y + 1e-4) * (2 * cov + 9e-4) / ((mu_x**2 + mu_y**2 + 1e-4) * (var_x + var_y + 9e-4))
    return float(0.8 * np.abs(x - y).mean() + 0.2 * (1 - ssim.mean()))


@pytest.mark.parametrize(("size", "to"), [((12, 20), (3, 5)), ((13, 9), (7, 5)), ((8, 8), (8, 8))])
def test_downsample_is_resize_and_its_gradient_the_adjoint(
    size: tuple[int, int], to: tuple[int, int]
) -> None:
    generator = torch.Generator().manual_seed(0)
    dense = [torch.from_numpy(resize_matrix(size[i], to[i])) for i in (0, 1)]
    down = Separable.of(dense[0].numpy(), dense[1].numpy())
    image = torch.rand(*size, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    out = down(image)
    expected = torch.einsum("hH,HWc,wW->hwc", dense[0], image, dense[1])
    assert torch.allclose(out, expected, rtol=0, atol=1e-14)
    v_out = torch.rand(*to, 3, generator=generator, dtype=torch.float64)
    (v_image,) = torch.autograd.grad(out, image, v_out)
    assert (out * v_out).sum().item() == pytest.approx((image * v_image).sum().item(), abs=1e-12)
    check = torch.rand(*size, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(down, check)


def test_loss_against_numpy() -> None:
    rng = np.random.default_rng(0)
    low = rng.random((4, 6, 3), dtype=np.float32)
    image = rng.random((16, 24, 3), dtype=np.float32)
    view = replace(tiny_scene().train[0], image=image, low=low)
    render = rng.normal(0.5, 0.3, (16, 24, 3)).astype(np.float32)
    small = np.einsum("hH,HWc,wW->hwc", resize_matrix(16, 4), render.astype(float), resize_matrix(24, 6))
    tie, texture = photometric_numpy(small, low), photometric_numpy(render.astype(float), image)
    assert abs(tie - texture) > 0.01
    for weight in (0.0, 0.4, 1.0):
        loss = loss_of(SRGS(SRGSConfig(texture_weight=weight)), torch.from_numpy(render), view)
        assert loss.item() == pytest.approx((1 - weight) * tie + weight * texture, abs=2e-6)
    assert SRGSConfig().texture_weight == 0.4


def test_gradient_of_the_loss() -> None:
    view = replace(tiny_scene().train[0], low=np.full((4, 6, 3), 0.3, np.float32))
    method = SRGS(SRGSConfig())
    render = torch.rand(16, 24, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda x: loss_of(method, x, view), render.requires_grad_(), fast_mode=True
    )


def test_a_photo_without_low_is_tied_at_half_its_size() -> None:
    view = tiny_scene().train[0]
    render = np.random.default_rng(0).random(view.image.shape, dtype=np.float32)
    photo = view.image.astype(float) / 255
    half = resize_matrix(16, 8), resize_matrix(24, 12)
    small = [np.einsum("hH,HWc,wW->hwc", half[0], x, half[1]) for x in (render.astype(float), photo)]
    expected = 0.6 * photometric_numpy(*small) + 0.4 * photometric_numpy(render.astype(float), photo)
    loss = loss_of(SRGS(SRGSConfig()), torch.from_numpy(render), view)
    assert loss.item() == pytest.approx(expected, abs=2e-6)


def test_without_low_and_with_factor_1_it_is_3dgs_bit_for_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "srgs", SRGS(SRGSConfig(own_factor=1)))
    trainers = [Trainer(tiny_scene(), tiny_config(12, method=name)) for name in ("srgs", "3dgs")]
    for _ in range(12):
        losses = [trainer.step().loss for trainer in trainers]
        assert losses[0] == losses[1]
    assert torch.equal(trainers[0].gaussians.means, trainers[1].gaussians.means)


def test_pixels_that_do_not_count_have_no_influence() -> None:
    rng = np.random.default_rng(0)
    mask = np.ones((16, 24), bool)
    mask[:3, :4] = False
    mask[9, 20] = False
    low = rng.random((8, 12, 3), dtype=np.float32)
    view = replace(tiny_scene().train[0], low=low, mask=mask)
    render = rng.random((16, 24, 3), dtype=np.float32)
    losses, gradients = [], []
    for value in (0.0, 50.0):
        x = torch.from_numpy(np.where(mask[..., None], render, np.float32(value))).requires_grad_()
        loss = loss_of(SRGS(SRGSConfig()), x, view)
        loss.backward()
        losses.append(loss.item())
        assert x.grad is not None
        gradients.append(x.grad.numpy())
    assert losses[0] == losses[1]
    assert not gradients[0][~mask].any()
    np.testing.assert_array_equal(gradients[0], gradients[1])


def test_low_pixels_count_where_all_that_they_are_made_from_counts() -> None:
    render = np.random.default_rng(0).random((16, 24, 3), dtype=np.float32)
    mask = np.ones((16, 24), bool)
    mask[:3, :4] = False
    mask[9, 20] = False
    reached = np.einsum("hH,HW,wW->hw", abs(resize_matrix(16, 8)), ~mask, abs(resize_matrix(24, 12))) > 0
    assert 0 < reached.sum() < reached.size
    low = np.where(reached[..., None], np.float32(9), resize(render, 8, 12))

    def subpixel(low: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> float:
        view = replace(tiny_scene().train[0], low=low, mask=mask)
        method = SRGS(SRGSConfig(texture_weight=0))
        return loss_of(method, torch.from_numpy(render), view).item()

    assert subpixel(low, mask) < 1e-6
    assert subpixel(low, None) > 0.1
    row, column = np.argwhere(~reached)[0]
    low[row, column] += 1
    assert subpixel(low, mask) > 1e-3


def test_a_mask_that_leaves_no_low_pixel_is_no_error() -> None:
    mask = np.zeros((16, 24), bool)
    mask[::2] = True
    view = replace(tiny_scene().train[0], low=np.zeros((4, 6, 3), np.float32), mask=mask)
    render = torch.full((16, 24, 3), 0.5)
    expected = 0.4 * loss_of(ThreeDGS(), render, view).item()
    assert loss_of(SRGS(SRGSConfig()), render, view).item() == pytest.approx(expected, rel=1e-6)


def test_photos_come_out_sharper_than_those_of_3dgs(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "srgs", SRGS(SRGSConfig()))
    scene, clean = fine_scene()
    values = {}
    for method in ("3dgs", "srgs"):
        trainer = run_until(
            Trainer(scene, tiny_config(300, method=method, densify=DensifyConfig(stop=0))), 300
        )
        trainer.prepared.given = replace(scene, test=scene.train)
        renders = [view.render for view in list(trainer.held_out())]
        values[method] = np.mean([psnr(r, c) or 0 for r, c in zip(renders, clean, strict=True)])
    assert values["srgs"] > values["3dgs"] + 1, values


@pytest.mark.parametrize(
    ("low", "message"),
    [
        (np.zeros((4, 6), np.float32), r"low is float32 \[4, 6\]"),
        (np.zeros((4, 6, 3)), r"low is float64 \[4, 6, 3\]"),
        (np.zeros((17, 6, 3), np.float32), r"up to 16 and w up to 24"),
        (np.full((4, 6, 3), np.nan, np.float32), "low holds NaN or Inf"),
    ],
)
def test_a_wrong_low_photo_is_named(low: NDArray[np.float32], message: str) -> None:
    view = replace(tiny_scene().train[0], low=low)
    with pytest.raises(ValueError, match=rf"view 'view1\.png': .*{message}"):
        SRGS(SRGSConfig()).prepare(view)


def test_wrong_values_are_named() -> None:
    with pytest.raises(ValueError, match=r"texture_weight is 1\.5"):
        SRGSConfig(texture_weight=1.5)
    with pytest.raises(ValueError, match="own_factor is 0"):
        SRGSConfig(own_factor=0)
    method = SRGS(SRGSConfig())
    assert method.param_groups() == []
    method.load_state_dict(method.state_dict())
    with pytest.raises(ValueError, match=r"no state of its own.*\['offset'\]"):
        method.load_state_dict({"offset": torch.zeros(1)})
