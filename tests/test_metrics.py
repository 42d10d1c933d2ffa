"""Metrics against definitions written out by hand, and the rules that they share."""

from __future__ import annotations

import hashlib
import importlib.util
import math
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from hqgs.evaluation import metrics
from hqgs.evaluation.metrics import (
    METRICS,
    ViewMetrics,
    evaluate_view,
    haarpsi,
    lpips,
    mean_metrics,
    psnr,
    psnr_aligned,
    ssim,
)

MISSING = "the optional package lpips is not installed (pip install 'hqgs[lpips]')"


def set_package(monkeypatch: pytest.MonkeyPatch, package: ModuleType | None) -> None:
    """Make `package` the lpips package that is installed."""
    spec_of = importlib.util.find_spec
    spec = package.__spec__ if package else None
    monkeypatch.setitem(sys.modules, "lpips", package)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: spec if name == "lpips" else spec_of(name))


@pytest.fixture(autouse=True)
def fresh_lpips(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No lpips package unless a test puts one in; the answer of an earlier test is forgotten."""
    set_package(monkeypatch, None)
    metrics._lpips_network.cache_clear()
    yield
    metrics._lpips_network.cache_clear()


def photo_of(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth waves with some noise, uint8 [H, W, 3]."""
    rng = np.random.default_rng(seed)
    i, j = np.mgrid[:height, :width]
    waves = np.stack([np.sin(i / (3 + c)) * np.cos(j / (4 - c)) for c in range(3)], axis=-1)
    noisy = 128 + 80 * waves + rng.normal(0, 12, waves.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def noisy(photo: np.ndarray, sigma: float, seed: int = 1) -> np.ndarray:
    """The photo with Gaussian noise, float32, not clipped."""
    return (photo / 255 + np.random.default_rng(seed).normal(0, sigma, photo.shape)).astype(np.float32)


def ssim_by_definition(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004, equation 13 with the weights of equations 14 to 16, one window at a time."""
    d = np.arange(11) - 5
    weights = np.exp(-(d[:, None] ** 2 + d[None, :] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    c1, c2 = 0.0001, 0.0009
    total = []
    for c in range(3):
        px, py = np.pad(x[..., c], 5), np.pad(y[..., c], 5)
        for i in range(x.shape[0]):
            for j in range(x.shape[1]):
                a, b = px[i : i + 11, j : j + 11], py[i : i + 11, j : j + 11]
                ma, mb = (weights * a).sum(), (weights * b).sum()
                va, vb = (weights * a * a).sum() - ma**2, (weights * b * b).sum() - mb**2
                cov = (weights * a * b).sum() - ma * mb
                total.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return float(np.mean(total))


@pytest.mark.parametrize(("offset", "db"), [(0.1, 20.0), (0.5, 6.020599913279624), (0.01, 40.0)])
def test_psnr_of_a_constant_offset(offset: float, db: float) -> None:
    photo = np.full((7, 5, 3), 51, np.uint8)  # 0.2 exactly
    assert psnr(np.full((7, 5, 3), 0.2 + offset), photo) == pytest.approx(db, abs=1e-9)


def test_psnr_averages_the_squared_error_over_channels_before_the_logarithm() -> None:
    photo = np.zeros((2, 2, 3), np.uint8)
    render = np.zeros((2, 2, 3))
    render[0, 0, 1] = 0.6
    assert psnr(render, photo) == pytest.approx(-10 * math.log10(0.36 / 12), abs=1e-12)


def test_render_is_clamped_but_not_rounded() -> None:
    white = np.full((16, 16, 3), 255, np.uint8)
    assert psnr(np.full((16, 16, 3), 1.7), white) is None  # clamped to white: identical
    assert ssim(np.full((16, 16, 3), 1.7), white) == 1.0
    quarter_step = 0.25 / 255  # an 8-bit rounding would remove it
    got = psnr(np.full((16, 16, 3), 1 - quarter_step), white)
    assert got == pytest.approx(-20 * math.log10(quarter_step), abs=1e-6)


def test_ssim_is_the_definition_with_zero_padding() -> None:
    photo = photo_of(13, 17)
    render = noisy(photo, 0.08)
    expected = ssim_by_definition(np.clip(render.astype(np.float64), 0, 1), photo / 255)
    assert 0.2 < expected < 0.95
    assert ssim(render, photo) == pytest.approx(expected, abs=1e-12)


def test_haarpsi_falls_as_the_render_gets_worse() -> None:
    photo = photo_of(48, 33)
    assert haarpsi(photo / 255, photo) == 1.0
    values = [haarpsi(noisy(photo, sigma), photo) for sigma in (0.01, 0.05, 0.2)]
    assert all(v is not None for v in values)
    assert 1 > values[0] > values[1] > values[2] > 0  # type: ignore[operator]
    black = np.zeros((32, 32, 3), np.uint8)
    assert haarpsi(black / 255, black) == 1.0
    assert haarpsi(np.full((32, 32, 3), 0.5), black) < 0.5  # type: ignore[operator]


def test_mask_leaves_pixels_out_of_psnr_and_copies_the_photo_elsewhere() -> None:
    photo = photo_of(24, 40)
    render = noisy(photo, 0.05)
    mask = np.ones((24, 40), bool)
    mask[:, 25:] = False
    spoilt = render.copy()
    spoilt[~mask] = 0.9
    copied = np.where(mask[..., None], render, (photo / 255)).astype(np.float64)

    assert psnr(spoilt, photo, mask) == psnr(render[:, :25], photo[:, :25])
    assert ssim(spoilt, photo, mask) == pytest.approx(ssim(copied, photo), abs=1e-12)
    assert haarpsi(spoilt, photo, mask) == pytest.approx(haarpsi(copied, photo), abs=1e-12)
    assert evaluate_view(spoilt, photo, mask) == evaluate_view(render, photo, mask)
    assert ssim(spoilt, photo) < ssim(spoilt, photo, mask)


def test_mask_that_leaves_no_pixel_gives_no_value() -> None:
    photo = photo_of(20, 20)
    got = evaluate_view(noisy(photo, 0.1), photo, np.zeros((20, 20), bool))
    reasons: dict[str, str] = dict.fromkeys(METRICS, "the mask hides every pixel")
    assert got == ViewMetrics(None, None, None, None, None, None, reasons)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    photo = photo_of(378, 504)  # large enough that torch splits its sums
    render = noisy(photo, 0.07)
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        results.append(evaluate_view(render, photo))
        assert torch.get_num_threads() == threads
    assert results[0] == results[1] == results[2]  # bit for bit
    assert results[0].psnr is not None


def test_missing_values_have_a_reason() -> None:
    photo = photo_of(12, 40)
    got = evaluate_view(photo / 255, photo)
    assert (got.psnr, got.haarpsi, got.lpips, got.lpips_vgg) == (None, None, None, None)
    assert got.ssim == pytest.approx(1)
    assert got.reasons == {
        "psnr": "render and photo are identical (infinite PSNR)",
        "haarpsi": "the view is shorter than 16 pixels on a side",
        "lpips": MISSING,
        "lpips_vgg": MISSING,
        "psnr_aligned": "render and photo differ only in brightness",
    }


def test_brightness_and_tint_can_be_set_aside() -> None:
    photo = photo_of(24, 20)
    tinted = (np.array([1.1, 0.8, 0.9]) * np.minimum(noisy(photo, 0.02), 0.8)).astype(np.float32)
    plain, aligned = psnr(tinted, photo), psnr_aligned(tinted, photo)
    assert plain is not None
    assert aligned is not None
    assert aligned > plain + 3
    # No other factor comes nearer.
    for factor in (0.98, 1.02):
        other = psnr(factor * _aligned(tinted, photo), photo)
        assert other is not None
        assert other < aligned
    # What the mask leaves out does not count.
    mask = np.ones((24, 20), dtype=bool)
    mask[:, :4] = False
    spoilt = np.where(mask[..., None], tinted, 0).astype(np.float32)
    assert psnr_aligned(spoilt, photo, mask) == psnr_aligned(tinted, photo, mask)
    # A black render has no factor.
    black = np.zeros(photo.shape, np.float32)
    assert psnr_aligned(black, photo) == psnr(black, photo)


def _aligned(render: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """By least squares, a channel at a time."""
    target = photo / 255
    found = [np.linalg.lstsq(render[..., c].reshape(-1, 1), target[..., c].ravel())[0] for c in range(3)]
    return np.clip(render * np.concatenate(found), 0, 1)


def test_mean_is_over_views_and_none_where_a_view_has_no_value() -> None:
    a = ViewMetrics(20.0, 0.5, 0.25, None, None, 21.0, {"lpips": "why", "lpips_vgg": "why"})
    b = ViewMetrics(
        30.0, 0.7, None, None, None, 30.0, {"haarpsi": "small", "lpips": "why", "lpips_vgg": "why"}
    )
    mean = mean_metrics([a, b])
    assert (mean.psnr, mean.ssim) == (25.0, pytest.approx(0.6))
    assert (mean.haarpsi, mean.lpips, mean.lpips_vgg) == (None, None, None)
    assert mean.reasons == {"haarpsi": "1 of 2 views: small", "lpips": "why", "lpips_vgg": "why"}
    assert mean_metrics([]).reasons == dict.fromkeys(METRICS, "there is no held-out photo")


@pytest.mark.parametrize(
    ("render", "mask", "message"),
    [
        (np.zeros((4, 5, 3)), None, r"render has shape \[4, 5, 3\], but photo has shape \[4, 4, 3\]"),
        (np.zeros((4, 4)), None, r"render must have shape \[H, W, 3\], got \[4, 4\]"),
        (np.zeros((4, 4, 3), np.int64), None, "render must be uint8 or floating point, got int64"),
        (np.full((4, 4, 3), np.nan), None, "render has 48 values that are NaN or Inf"),
        (np.zeros((4, 4, 3)), np.ones((4, 5), bool), r"mask must be bool of shape \[4, 4\]"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), "mask must be bool"),
        (np.zeros((4, 4, 3)), np.zeros((4, 5), bool), "mask must be bool"),
    ],
)
def test_bad_input_is_named(render: np.ndarray, mask: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate_view(render, np.zeros((4, 4, 3), np.uint8), mask)


class RecordingLpips(torch.nn.Module):
    """Stands in for the network of the lpips package: gives the mean absolute difference of its inputs."""

    made: list[str]

    def __init__(self, net: str, verbose: bool) -> None:
        super().__init__()
        assert not verbose
        RecordingLpips.made.append(net)

    def forward(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        assert x.shape == y.shape == (1, 3, 64, 80)
        assert float(y.min()) == -1
        assert float(y.max()) == 1
        return (x - y).abs().mean().reshape(1, 1, 1, 1)


@pytest.fixture
def fake_lpips(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An lpips package whose networks can be built, and an empty checkpoint folder of torch (returned)."""
    package = ModuleType("lpips")
    package.__spec__ = ModuleSpec("lpips", None)
    package.LPIPS = RecordingLpips  # type: ignore[attr-defined]
    RecordingLpips.made = []
    set_package(monkeypatch, package)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def test_lpips_is_not_built_without_its_local_weights(fake_lpips: Path) -> None:
    photo = photo_of(64, 80)
    assert lpips(noisy(photo, 0.1), photo) is None
    name = metrics.LPIPS_BACKBONES["alex"]
    assert (
        metrics.lpips_missing("alex") == f"the backbone weights {name} are not in torch's checkpoint folder"
    )
    metrics._lpips_network.cache_clear()
    (fake_lpips / name).write_bytes(b"cut off")
    digest = hashlib.sha256(b"cut off").hexdigest()
    assert metrics.lpips_missing("alex") == (
        f"the backbone weights {name} are damaged (SHA-256 starts with {digest[:8]})"
    )
    assert RecordingLpips.made == []


def test_lpips_gets_images_scaled_to_plus_minus_one_and_is_built_once(
    fake_lpips: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = b"weights"
    name = f"net-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    (fake_lpips / name).write_bytes(content)
    monkeypatch.setitem(metrics.LPIPS_BACKBONES, "alex", name)
    photo = photo_of(64, 80)
    photo[0, :2] = [[0, 0, 0], [255, 255, 255]]
    render = np.clip(noisy(photo, 0.1), 0, 1)
    expected = 2 * np.abs(render - photo / 255).mean()
    assert lpips(render, photo) == pytest.approx(expected, rel=1e-6)
    got = evaluate_view(render, photo)
    assert got.lpips == pytest.approx(expected, rel=1e-6)
    assert got.lpips_vgg is None
    assert "vgg16" in got.reasons["lpips_vgg"]
    assert RecordingLpips.made == ["alex"]


def test_backbone_names_are_those_of_torchvision() -> None:
    models = pytest.importorskip("torchvision.models")
    urls = {"alex": models.AlexNet_Weights.IMAGENET1K_V1.url, "vgg": models.VGG16_Weights.IMAGENET1K_V1.url}
    assert {net: url.rsplit("/", 1)[1] for net, url in urls.items()} == metrics.LPIPS_BACKBONES


def test_unknown_lpips_backbone_is_refused() -> None:
    with pytest.raises(ValueError, match='net must be "alex" or "vgg", got \'squeeze\''):
        metrics.lpips_missing("squeeze")
