"""The photometric loss against the textbook formula in plain torch, float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from hqgs import _rust
from hqgs._rust import set_num_threads
from hqgs.training.methods.photometric import photometric_loss


def reference(render: Tensor, target: Tensor, mask: Tensor | None, lambda_dssim: float) -> Tensor:
    """L1 and SSIM from five windowed means; `target` on the render's scale."""
    if mask is None:
        mask = torch.ones(render.shape[:2], dtype=torch.bool)
    l1 = (render - target).abs()[mask].mean()
    x = torch.where(mask[..., None], render, target).permute(2, 0, 1)[:, None]
    y = target.permute(2, 0, 1)[:, None]
    taps = torch.exp(-((torch.arange(11, dtype=x.dtype) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2

    def mean(image: Tensor) -> Tensor:
        return conv2d(image, window[None, None], padding=5)

    mu_x, mu_y = mean(x), mean(y)
    var_x, var_y, cov = mean(x * x) - mu_x**2, mean(y * y) - mu_y**2, mean(x * y) - mu_x * mu_y
    ssim = (2 * mu_x * mu_y + 0.01**2) * (2 * cov + 0.03**2)
    ssim = ssim / ((mu_x**2 + mu_y**2 + 0.01**2) * (var_x + var_y + 0.03**2))
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim.mean())


def images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """A render (float64, partly outside [0, 1]), a photo (uint8) and a mask."""
    rng = np.random.default_rng(seed)
    photo = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    render = photo / 255 + rng.normal(0, 0.2, photo.shape)
    return (
        torch.from_numpy(render),
        torch.from_numpy(photo),
        torch.from_numpy(rng.random((height, width)) > 0.3),
    )


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 40), (7, 5), (33, 17), (70, 41)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
def test_value_and_gradient_agree_with_plain_torch(
    height: int, width: int, masked: bool, lambda_dssim: float
) -> None:
    render, photo, mask = images(height, width)
    mask[0, 0] = True
    used = mask if masked else None
    render.requires_grad_()
    expected = reference(render, photo.double() / 255, used, lambda_dssim)
    (expected_grad,) = torch.autograd.grad(expected, render)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        x = render.detach().to(dtype).requires_grad_()
        value = photometric_loss(x, photo, used, lambda_dssim)
        (3 * value).backward()
        assert value.dtype == dtype
        assert value.shape == ()
        assert abs(value.item() - expected.item()) < tolerance
        assert x.grad is not None
        off = (x.grad / 3 - expected_grad).norm() / expected_grad.norm()
        assert off < 10 * tolerance


@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2])
def test_with_a_knee_it_is_hubers_function(lambda_dssim: float) -> None:
    render, photo, mask = images(33, 17)
    target = photo.double() / 255
    render.requires_grad_()
    huber = torch.nn.functional.huber_loss(render[mask], target[mask], delta=0.15) / 0.15
    without = (1 - lambda_dssim) * (render - target).abs()[mask].mean()
    expected = reference(render, target, mask, lambda_dssim) - without + (1 - lambda_dssim) * huber
    (expected_grad,) = torch.autograd.grad(expected, render)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        x = render.detach().to(dtype).requires_grad_()
        value = photometric_loss(x, photo, mask, lambda_dssim, knee=0.15)
        value.backward()
        assert abs(value.item() - expected.item()) < tolerance
        assert x.grad is not None
        assert (x.grad - expected_grad).norm() < 10 * tolerance * expected_grad.norm()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_smallest_knee_is_none(dtype: torch.dtype) -> None:
    render, photo, _ = images(20, 10)
    render = render.to(dtype)
    target = photo.to(dtype) / 255
    render[:5] = target[:5]
    for knee in (5e-324, 1e-300, 1e-44):
        x, y = (render.clone().requires_grad_() for _ in range(2))
        value = photometric_loss(x, target, lambda_dssim=0.0, knee=knee)
        plain = photometric_loss(y, target, lambda_dssim=0.0)
        assert value.item() == pytest.approx(plain.item(), rel=1e-6)
        value.backward()
        plain.backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()
        assert torch.equal(x.grad, y.grad), knee  # type: ignore[arg-type]


def test_target_of_floats_and_a_render_that_is_not_contiguous() -> None:
    render, photo, _ = images(12, 10)
    target = photo.double() / 255
    expected = photometric_loss(render, photo)
    assert photometric_loss(render, target).item() == pytest.approx(expected.item(), abs=1e-15)
    strided = render.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not strided.is_contiguous()
    assert photometric_loss(strided, photo) == expected


def test_masked_pixels_get_no_gradient_and_may_be_nan() -> None:
    render, photo, mask = images(20, 20)
    expected = photometric_loss(render, photo, mask)
    render[~mask] = math.nan
    render.requires_grad_()
    value = photometric_loss(render, photo, mask)
    value.backward()
    assert value.item() == expected.item()
    assert render.grad is not None
    assert (render.grad[~mask] == 0).all()
    assert (render.grad[mask] != 0).all()


def test_nan_is_passed_on() -> None:
    render, photo, _ = images(20, 20)
    render[7, 3, 1] = math.nan
    assert photometric_loss(render, photo).isnan()
    assert photometric_loss(render, photo, lambda_dssim=0.0).isnan()


def test_same_bits_for_any_number_of_threads() -> None:
    render, photo, _ = images(150, 31)
    results = []
    for threads in (1, 2, 3):
        set_num_threads(threads)
        x = render.float().requires_grad_()
        value = photometric_loss(x, photo)
        value.backward()
        assert x.grad is not None
        results.append((value.item(), x.grad))
    assert all(value == results[0][0] and torch.equal(grad, results[0][1]) for value, grad in results)


def test_ssim_of_the_binding() -> None:
    render, photo, mask = images(21, 13)
    counts = mask.numpy().view(np.uint8)
    target = photo.double() / 255
    for used, array in ((mask, counts), (None, None)):
        expected = 1 - reference(render, target, used, 1.0).item()
        _, _, value, _ = _rust.photometric(render.numpy(), target.numpy(), array, 1.0, 0.0, False)
        assert value == pytest.approx(expected, abs=1e-12)


def test_bad_input_is_named() -> None:
    render, photo, mask = images(6, 5)
    for name, call in {
        "render": lambda: photometric_loss(render.half(), photo),
        "render: expected shape": lambda: photometric_loss(render[0], photo[0]),
        "render: expected": lambda: photometric_loss(render[:0], photo[:0]),
        "target": lambda: photometric_loss(render, photo.int()),
        "target: no gradient": lambda: photometric_loss(render, render.clone().requires_grad_()),
        "target: expected shape": lambda: photometric_loss(render, photo[:5]),
        "mask": lambda: photometric_loss(render, photo, mask.int()),
        "mask: expected shape": lambda: photometric_loss(render, photo, mask[:, :4]),
        "lambda_dssim": lambda: photometric_loss(render, photo, lambda_dssim=1.5),
        "knee": lambda: photometric_loss(render, photo, knee=-0.1),
        "render: must be on the CPU": lambda: photometric_loss(render.to("meta"), photo),
    }.items():
        with pytest.raises(ValueError, match=name):
            call()
    with pytest.raises(ValueError, match="render: must be C-contiguous"):
        _rust.photometric(render.numpy().transpose(1, 0, 2), photo.numpy(), None, 0.2, 0.0, False)
