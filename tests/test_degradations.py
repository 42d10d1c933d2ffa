"""Each degradation against its definition, computed another way."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
from fixtures_scenes import degrade_image
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, stats

from hqgs.photos.degrade import Degraded, convolve, gaussian_blur, shrink
from hqgs.photos.formation import disc_kernel, motion_kernel
from hqgs.photos.formula import KINDS, MIXED_STEPS, NOT_MADE, Degradation, parse_degradation
from hqgs.photos.resize import resize


def photo(height: int = 40, width: int = 56) -> NDArray[np.uint8]:
    """A wavy picture with some grain, uint8."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:height, :width]
    waves = [0.5 + 0.4 * np.sin(x / 5 + c) * np.cos(y / (4 + c)) for c in range(3)]
    return np.rint(255 * (np.stack(waves, -1) + rng.normal(0, 0.02, (height, width, 3))).clip(0, 1)).astype(
        np.uint8
    )


def degrade(text: str, image: NDArray[np.uint8] | NDArray[np.float32], seed: int = 0) -> Degraded:
    return degrade_image(image, parse_degradation(text), np.random.default_rng(seed))


# --- text


@pytest.mark.parametrize(
    "text",
    [
        *("none", "jpeg:5", "noise:0.5", "lowres:4", "blur", "blur:2.5", "defocus", "motion:21", "mixed"),
        *("blur:2+jpeg:20", "jpeg:20+blur:2", "blur+lowres:2+noise:10"),
        *("shake", "shake:7.5", "exposure:0.5", "chat:640", "phone", "phone:3", "video:23"),
        *("some:shake", "some:noise:25", "some:blur+jpeg:30", "shake+exposure+video:30"),
    ],
)
def test_text_comes_back(text: str) -> None:
    assert str(parse_degradation(text)) == text


def test_canonical_text() -> None:
    assert str(parse_degradation("jpeg:5.0+noise:1e1")) == "jpeg:5+noise:10"
    assert str(parse_degradation("mixed+noise:3")) == "blur+lowres:2+noise:10+jpeg:20+noise:3"
    assert str(parse_degradation("blur+lowres:2+noise:10+jpeg:20")) == "mixed"
    assert parse_degradation("mixed") == Degradation(MIXED_STEPS)
    assert parse_degradation("none") == Degradation(())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "",
            f"unknown degradation ''; there are: {', '.join(KINDS)}, mixed, none, some:KIND, and steps "
            "joined by \\+",
        ),
        ("fog:3", "unknown degradation 'fog'"),
        ("blur:2+", "unknown degradation ''"),
        ("blur:2 + jpeg:20", "unknown degradation ' jpeg'"),
        ("jpeg", "jpeg needs a value: jpeg:VALUE with a quality, an integer in 1..95"),
        ("jpeg:0", "jpeg is 0, wanted a quality, an integer in 1..95"),
        ("jpeg:96", "jpeg is 96, wanted a quality, an integer in 1..95"),
        ("jpeg:9.5", "jpeg is 9.5, wanted a quality, an integer in 1..95"),
        ("noise:0", "noise is 0, wanted a standard deviation, where white is 255, 0.01..255"),
        ("noise:-3", "noise is -3"),
        ("noise:256", "noise is 256"),
        ("lowres:1", "lowres is 1, wanted a factor, an integer in 2..16"),
        ("lowres:17", "lowres is 17"),
        ("blur:0", "blur is 0, wanted sigma in px, 0.1..50"),
        ("defocus:99", "defocus is 99, wanted a radius in px, 0.5..50"),
        ("motion:0.5", "motion is 0.5, wanted a length in px, 1..200"),
        ("motion:nan", "'nan' in the degradation 'motion:nan' is not a number"),
        ("noise:inf", "'inf' in the degradation 'noise:inf' is not a number"),
        ("noise:", "'' in the degradation 'noise:' is not a number"),
        ("jpeg:5:6", "'5:6' in the degradation 'jpeg:5:6' is not a number"),
        ("none+blur", "'none' cannot be joined with others, got the degradation 'none\\+blur'"),
        ("mixed:3", "unknown degradation 'mixed'"),
        ("shake:0.1", "shake is 0.1, wanted the longest extent of a shake in px, 0.5..200"),
        ("exposure:9", "exposure is 9, wanted the largest deviation in stops, 0.01..4"),
        ("chat:7", "chat is 7, wanted the longest side in px, an integer in 8..10000"),
        ("phone:-1", "phone is -1, wanted stops of light that are missing, 0..12"),
        ("video:52", "video is 52, wanted a constant rate factor, an integer in 0..51"),
        ("video:20.5", "video is 20.5, wanted a constant rate factor, an integer"),
        ("some", "some takes one of jpeg, noise, blur, .*; got some:$"),
        ("some:lowres:2", "some takes one of jpeg, noise, blur, .*; got some:lowres"),
        ("some:video", "got some:video"),
        ("some:mixed", "got some:mixed"),
        ("some:fog", "got some:fog"),
        ("some:noise", "noise needs a value"),
        ("some:noise:x", "'x' in the degradation 'some:noise:x' is not a number"),
        ("some:jpeg:0", "jpeg is 0"),
        ("focus", "focus depends on depths, .*; defocus:R blurs the whole photo"),
        ("blur+grain", "grain means that each photo has its own noise; some:noise:SIGMA makes such photos"),
    ],
)
def test_bad_text_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_degradation(text)


def test_defaults_scale_with_the_width() -> None:
    """Of the picture that the step meets: a blur after lowres:2 has half as many pixels."""

    def at(text: str, width: int) -> str:
        return str(parse_degradation(text).for_width(width))

    assert at("blur+noise:3", 504) == "blur:2.5+noise:3"
    assert at("defocus+motion", 1008) == "defocus:10+motion:30"
    assert at("blur:3", 1008) == "blur:3"
    assert at("mixed", 504) == "blur:2.5+lowres:2+noise:10+jpeg:20"
    assert at("lowres:4+blur", 503) == "lowres:4+blur:0.625"
    assert at("blur+defocus+motion", 8) == "blur:0.1+defocus:0.5+motion:1"  # held to the range
    image = photo(40, 252)
    np.testing.assert_array_equal(degrade("blur", image).image, degrade("blur:1.25", image).image)


# --- noise


@pytest.mark.parametrize("sigma", [10, 25, 50])
def test_noise_is_normal_with_the_stated_deviation(sigma: int) -> None:
    clean = np.full((200, 300, 3), 128, np.uint8)
    noise = (degrade(f"noise:{sigma}", clean).image - np.float32(128 / 255)) * 255 / sigma
    count = noise.size
    assert abs(noise.mean()) < 4 / math.sqrt(count)
    assert abs(noise.std() - 1) < 4 / math.sqrt(2 * count)
    assert stats.kstest(noise.ravel()[::7], "norm").pvalue > 1e-3


def test_noise_is_independent_between_photos_channels_and_pixels() -> None:
    clean = np.zeros((200, 300, 3), np.uint8)
    a, b = degrade("noise:25", clean, 0).image, degrade("noise:25", clean, 1).image

    def correlation(x: NDArray[np.float32], y: NDArray[np.float32]) -> float:
        return float(np.corrcoef(x.ravel(), y.ravel())[0, 1])

    assert abs(correlation(a, b)) < 4 / math.sqrt(a.size)
    assert abs(correlation(a[..., 0], a[..., 1])) < 4 / math.sqrt(a.size / 3)
    assert abs(correlation(a[1:], a[:-1])) < 4 / math.sqrt(a.size)
    assert abs(correlation(a[:, 1:], a[:, :-1])) < 4 / math.sqrt(a.size)


def test_noise_is_neither_clipped_nor_rounded() -> None:
    dark = degrade("noise:25", np.zeros((50, 50, 3), np.uint8)).image
    assert 0.45 < (dark < 0).mean() < 0.55
    bright = degrade("noise:25", np.full((50, 50, 3), 255, np.uint8)).image
    assert 0.45 < (bright > 1).mean() < 0.55
    off = np.abs(bright * 255 - np.rint(bright * 255))
    assert 0.2 < off.mean() < 0.3  # a quarter, where values fall anywhere between two levels


# --- JPEG


@pytest.mark.parametrize("quality", [5, 10, 20, 95])
def test_jpeg_is_pillows_round_trip(quality: int) -> None:
    clean = photo()
    file = io.BytesIO()
    Image.fromarray(clean).save(file, "JPEG", quality=quality, subsampling=2)
    result = degrade(f"jpeg:{quality}", clean)
    assert result.jpeg == file.getvalue()
    assert result.low is None
    np.testing.assert_array_equal(result.image * 255, np.asarray(Image.open(file)))


def test_jpeg_clips_and_rounds_its_input() -> None:
    rng = np.random.default_rng(3)
    wild = rng.uniform(-0.5, 1.5, (24, 32, 3)).astype(np.float32)
    tame = np.rint(np.clip(wild, 0, 1) * 255).astype(np.uint8)
    assert degrade("jpeg:90", wild).jpeg == degrade("jpeg:90", tame).jpeg


def test_jpeg_bytes_are_given_only_where_they_are_the_result() -> None:
    assert degrade("jpeg:20+blur:2", photo()).jpeg is None
    assert degrade("blur:2", photo()).jpeg is None
    mixed = degrade("mixed", photo())
    assert mixed.jpeg is not None
    assert mixed.low is not None
    np.testing.assert_array_equal(mixed.low * 255, np.asarray(Image.open(io.BytesIO(mixed.jpeg))))


# --- low resolution


@pytest.mark.parametrize(("factor", "low"), [(2, (20, 28)), (4, (10, 14)), (8, (5, 7)), (3, (14, 19))])
def test_lowres_is_small_and_enlarged_back(factor: int, low: tuple[int, int]) -> None:
    clean = photo()
    result = degrade(f"lowres:{factor}", clean)
    assert result.low is not None
    assert result.low.shape == (*low, 3)
    assert result.low.dtype == result.image.dtype == np.float32
    np.testing.assert_array_equal(result.low, resize((clean / 255).astype(np.float32), *low))
    np.testing.assert_array_equal(result.image, resize(result.low, 40, 56))


@pytest.mark.parametrize("factor", [2, 3, 4, 8])
def test_lowres_keeps_what_it_can_hold_in_place(factor: int) -> None:
    """Slow waves come back, also where the sides are no multiples of the factor: nothing moves."""
    y, x = (np.mgrid[:94, :126] + 0.5).astype(np.float32)
    clean = 0.5 + 0.4 * np.cos(np.pi * 2 * x / 126) * np.cos(np.pi * y / 94)
    back = degrade(f"lowres:{factor}", np.repeat(clean[..., None], 3, -1)).image
    assert np.abs(back[..., 0] - clean).max() < 0.02
    assert np.abs(back[..., 0] - clean).max() < 0.4 * np.abs(np.diff(clean)).max() * factor


def test_later_steps_happen_to_the_small_photo() -> None:
    clean = np.full((64, 96, 3), 128, np.uint8)
    result = degrade("lowres:4+noise:25", clean, seed=5)
    assert result.low is not None
    assert result.low.shape == (16, 24, 3)
    noise = np.random.default_rng(5).standard_normal((16, 24, 3), np.float32)
    np.testing.assert_allclose((result.low - 128 / 255) * 255 / 25, noise, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(result.image, resize(result.low, 64, 96))
    before = degrade("noise:25+lowres:4", clean, seed=5)
    assert before.low is not None
    assert before.low.std() < 0.4 * result.low.std()  # averaged away by making it small


# --- blur


@pytest.mark.parametrize("sigma", [0.4, 1.0, 1.5, 4.0])
def test_blur_is_the_gaussian_and_mirrors_the_border_without_repeating_the_edge(sigma: float) -> None:
    image = np.random.default_rng(4).random((20, 26, 3), np.float32)
    expected = ndimage.gaussian_filter(
        image.astype(np.float64), (sigma, sigma, 0), mode="mirror", truncate=4.0
    )  # scipy's name of this border
    np.testing.assert_allclose(gaussian_blur(image, sigma), expected, rtol=0, atol=1e-7)


def test_convolve_is_the_direct_sum() -> None:
    rng = np.random.default_rng(5)
    image, kernel = rng.random((17, 23, 3), np.float32), rng.random((7, 5))
    expected = np.stack(
        [ndimage.convolve(image[..., c].astype(float), kernel, mode="mirror") for c in range(3)]
    )
    np.testing.assert_allclose(convolve(image, kernel), expected.transpose(1, 2, 0), rtol=0, atol=1e-5)


@pytest.mark.parametrize("text", ["blur:5", "defocus:20", "motion:80"])
def test_a_blur_too_wide_for_the_photo_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"px, too far for a photo of 56 x 18 px"):
        degrade(text, photo(18))


@pytest.mark.parametrize("radius", [0.1, 0.5, 0.9, 2.0, 5.0, 11.3])
def test_disc(radius: float) -> None:
    """Shares of area by counting the points of a fine lattice."""
    kernel = disc_kernel(radius)
    reach = kernel.shape[0] // 2
    fine = (np.arange(100 * (2 * reach + 1)) + 0.5) / 100 - reach - 0.5
    counted = (fine[:, None] ** 2 + fine**2 <= radius**2).astype(float)
    shares = counted.reshape(2 * reach + 1, 100, 2 * reach + 1, 100).mean((1, 3)) / (math.pi * radius**2)
    np.testing.assert_allclose(kernel / kernel.max(), shares / shares.max(), rtol=0, atol=0.01)
    assert abs(shares.sum() - 1) < 0.02  # the whole disc lies in the kernel
    assert abs(kernel.sum() - 1) < 1e-12
    np.testing.assert_array_equal(kernel, kernel.T)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], rtol=0, atol=1e-15)
    if radius <= 0.5:
        assert kernel.tolist() == [[1.0]]  # nothing happens


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi / 2, 2.2])
@pytest.mark.parametrize("length", [1.0, 9.0, 15.5])
def test_motion_is_the_mean_over_shifts(length: float, angle: float) -> None:
    image, shots = np.random.default_rng(6).random((41, 43)), 400
    mean = np.zeros_like(image)
    for t in ((np.arange(shots) + 0.5) / shots - 0.5) * length:
        mean += (
            ndimage.shift(image, (t * math.sin(angle), t * math.cos(angle)), order=1, mode="mirror") / shots
        )
    blurred = convolve(np.repeat(image[..., None], 3, -1).astype(np.float32), motion_kernel(length, angle))
    np.testing.assert_allclose(blurred[..., 1], mean, rtol=0, atol=1e-4)


def test_motion_draws_its_direction() -> None:
    still, again, other = (degrade("motion:9", photo(), seed).image for seed in (0, 0, 1))
    np.testing.assert_array_equal(still, again)
    assert np.abs(still - other).max() > 0.01


# --- all together


def test_steps_happen_in_the_written_order() -> None:
    clean = photo()
    soft = gaussian_blur((clean / 255).astype(np.float32), 2.0)
    eight_bits = np.rint(soft.clip(0, 1) * 255).astype(np.uint8)
    np.testing.assert_array_equal(
        degrade("blur:2+jpeg:20", clean).image, degrade("jpeg:20", eight_bits).image
    )
    blocks = degrade("jpeg:20", clean).image
    np.testing.assert_array_equal(degrade("jpeg:20+blur:2", clean).image, gaussian_blur(blocks, 2.0))


def test_mixed_by_hand() -> None:
    clean = photo(60, 126)
    small = shrink(gaussian_blur((clean / 255).astype(np.float32), 2.5 / 4), 2)
    assert small.shape == (30, 63, 3)
    noisy = small + np.float32(10 / 255) * np.random.default_rng(8).standard_normal((30, 63, 3), np.float32)
    file = io.BytesIO()
    pixels = np.rint(noisy.clip(0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(file, "JPEG", quality=20, subsampling=2)
    result = degrade("mixed", clean, seed=8)
    assert result.jpeg == file.getvalue()
    small = (np.asarray(Image.open(file)) / 255).astype(np.float32)
    np.testing.assert_array_equal(result.image, resize(small, 60, 126))


def test_none_gives_the_photo() -> None:
    result = degrade("none", photo())
    assert result == Degraded(result.image, None, None)
    np.testing.assert_array_equal(np.rint(result.image * 255), photo())
    own = np.random.default_rng(0).random((9, 9, 3), np.float32)
    copy = degrade("none", own).image
    np.testing.assert_array_equal(copy, own)
    assert not np.shares_memory(copy, own)


@pytest.mark.parametrize(
    "text", [*(f"{k}:{int(v.lowest) or 1}" for k, v in KINDS.items() if k not in NOT_MADE), "mixed"]
)
def test_the_same_seed_gives_the_same_bits(text: str) -> None:
    clean = photo()
    kept = clean.copy()
    first = degrade(text, clean)
    torch.set_num_threads(3)
    second = degrade(text, (clean / 255).astype(np.float32))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(clean, kept)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((8, 8), np.uint8), r"\(8, 8\) uint8"),
        (np.zeros((8, 8, 4), np.uint8), r"\(8, 8, 4\) uint8"),
        (np.zeros((8, 8, 3), np.float64), r"\(8, 8, 3\) float64"),
        (np.full((8, 8, 3), np.nan, np.float32), "NaN or Inf"),
    ],
)
def test_a_bad_photo_is_refused(image: NDArray[np.uint8], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        degrade("jpeg:5", image)
