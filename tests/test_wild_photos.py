"""What a hand, a camera, a messenger, a phone and an encoder do to a photo, computed another way."""

from __future__ import annotations

import io
import sys
from itertools import pairwise

import numpy as np
import pytest
from fixtures_scenes import degrade_image
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from test_diagnose import clean_photo

from benchmarks.scenes.kinds import draw_gains, shake
from benchmarks.scenes.phone import WHITE_BALANCE, bayer_mosaic, demosaic, denoise, phone_jpeg
from benchmarks.scenes.shake import (
    draw_path,
    exposure_times,
    knots_mean,
    path_extent,
    path_length,
    path_points,
    shake_kernel,
)  # fmt: skip
from benchmarks.scenes.video import film
from hqgs.photos.degrade import degrade_sequence
from hqgs.photos.formation import formation
from hqgs.photos.formula import KINDS, OWN, parse_degradation, parse_formation
from hqgs.photos.light import to_linear, to_srgb
from hqgs.photos.pixels import as_floats

NEW = ("shake", "exposure", "chat", "phone", "video")
NOT_TOLD = tuple(kind for kind in NEW if kind not in OWN)


def picture(height: int = 61, width: int = 90, shift: float = 0.0) -> NDArray[np.float32]:
    """Waves of several lengths and an edge, within [0.05, 0.95], float32 [H, W, 3]."""
    y, x = np.mgrid[:height, :width]
    x = x + shift
    waves = [0.45 + 0.2 * np.sin(0.3 * x + k) * np.cos(0.2 * y) + 0.2 * (x + y > 70) for k in range(3)]
    return np.stack(waves, -1).astype(np.float32)


def random_path(seed: int, extent: float = 9.0) -> NDArray[np.float64]:
    return draw_path(np.random.default_rng(seed), extent)


# --- light


def test_srgb_at_known_values() -> None:
    """The two ends, the middle grey of 18 % light, and the point where the pieces meet (IEC 61966-2-1)."""
    linear = np.array([0.0, 0.0031308, 0.18, 1.0])
    np.testing.assert_allclose(to_srgb(linear), [0, 0.04045, 0.461356, 1], atol=2e-6)
    values = np.linspace(-0.1, 1.2, 500)
    np.testing.assert_allclose(to_srgb(to_linear(values)), values, atol=3e-7)
    assert to_linear(values.astype(np.float32)).dtype == np.float32


# --- shake


@pytest.mark.parametrize("seed", range(5))
def test_a_path_has_its_extent_and_no_mean(seed: int) -> None:
    knots = random_path(seed, 11.0)
    times = np.linspace(-0.5, 0.5, 4001)
    points = path_points(knots, times)
    for axis in (0, 1):  # by numpy's own polynomial through the knots
        cubic = np.polynomial.Polynomial.fit([-0.5, -1 / 6, 1 / 6, 0.5], knots[:, axis], 3)
        np.testing.assert_allclose(points[:, axis], cubic(times), atol=1e-10)
        assert cubic.integ()(0.5) - cubic.integ()(-0.5) == pytest.approx(0, abs=1e-12)
    far = max(float(np.linalg.norm(points - p, axis=1).max()) for p in points[::10])
    assert far == pytest.approx(11.0, rel=2e-3)
    assert path_extent(knots) == pytest.approx(11.0, rel=1e-12)
    along = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    assert path_length(knots) == pytest.approx(along, rel=1e-3)
    assert along >= 0.999 * far
    np.testing.assert_allclose(knots_mean(knots), 0, atol=1e-12)


def test_paths_are_curved_and_go_everywhere() -> None:
    paths = [random_path(seed, 1.0) for seed in range(200)]
    ends = np.array([p[3] - p[0] for p in paths])
    assert np.abs(ends.mean(0)).max() < 0.2
    straight = np.array([path_extent(p) / path_length(p) for p in paths])
    assert (straight < 0.97).mean() > 0.3
    assert straight.max() <= 1.001


@pytest.mark.parametrize("extent", [0.5, 3.3, 24.0])
def test_kernel_sums_to_one_around_its_middle(extent: float) -> None:
    for seed in range(4):
        kernel = shake_kernel(random_path(seed, extent))
        assert kernel.shape[0] == kernel.shape[1]
        assert kernel.shape[0] % 2 == 1
        assert (kernel >= 0).all()
        assert kernel.sum() == pytest.approx(1, abs=1e-12)
        reach = kernel.shape[0] // 2
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        assert (kernel * x).sum() == pytest.approx(0, abs=1e-12)
        assert (kernel * y).sum() == pytest.approx(0, abs=1e-12)
        ys, xs = np.nonzero(kernel)
        assert max(np.ptp(xs), np.ptp(ys)) <= extent + 2


def test_shake_is_the_mean_of_moved_photos_in_linear_light() -> None:
    image, knots = picture(), random_path(3, 9.0)
    points = path_points(knots, exposure_times(400))
    light = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype(np.float64)
    total = np.zeros_like(light)
    for dx, dy in points:  # what was at x is at x + dx
        for c in range(3):
            total[..., c] += ndimage.shift(light[..., c], (dy, dx), order=1, mode="mirror")
    mean = total / len(points)
    expected = np.where(mean <= 0.0031308, 12.92 * mean, 1.055 * mean ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shake(image, knots), expected, atol=2e-3)
    assert np.abs(shake(image, -knots) - expected).max() > 0.03  # the direction counts
    plain = ndimage.convolve(image[..., 0].astype(np.float64), shake_kernel(knots), mode="mirror")
    assert np.abs(plain - expected[..., 0]).max() > 0.01  # the light counts


def test_each_photo_has_a_path_of_its_own() -> None:
    image, extents = picture(), []
    for seed in range(24):
        out = degrade_image(image, parse_degradation("shake:10"), np.random.default_rng(seed))
        (record,) = out.records
        knots = np.array(record["path"])
        np.testing.assert_array_equal(out.image, shake(image, knots))
        assert path_extent(knots) == pytest.approx(record["extent"])
        assert path_length(knots) == pytest.approx(record["length"])
        extents.append(record["extent"])
    assert 2 <= min(extents) < 3
    assert 9 < max(extents) <= 10


# --- exposure


def test_gains_are_found_by_regression() -> None:
    image = np.float32(0.4) * picture()  # nothing is clipped
    for seed in range(6):
        out = degrade_image(image, parse_degradation("exposure"), np.random.default_rng(seed))
        (record,) = out.records
        before, after = to_linear(image.astype(np.float64)), to_linear(out.image.astype(np.float64))
        for c in range(3):
            gain, offset = np.polyfit(before[..., c].ravel(), after[..., c].ravel(), 1)
            assert gain == pytest.approx(record["gains"][c], rel=1e-4)
            assert offset == pytest.approx(0, abs=1e-5)


def test_gains_stay_in_their_range_and_white_is_white() -> None:
    stops = np.log2([draw_gains(np.random.default_rng(k), 0.8) for k in range(400)])
    assert 0.75 < np.abs(stops[:, 1]).max() <= 0.8
    for c in (0, 2):
        against = stops[:, c] - stops[:, 1]
        assert 0.18 < np.abs(against).max() <= 0.2
        assert abs(against.mean()) < 0.02
    bright = np.full((9, 9, 3), 0.9, np.float32)
    images = [
        degrade_image(bright, parse_degradation("exposure:2"), np.random.default_rng(k)).image
        for k in range(9)
    ]
    assert max(image.max() for image in images) == pytest.approx(1, abs=1e-6)


# --- chat


@pytest.mark.parametrize(("size", "small"), [((61, 90), (30, 45)), ((90, 61), (45, 30))])
def test_a_messenger_by_pillow(size: tuple[int, int], small: tuple[int, int]) -> None:
    """Pillow's bicubic filter is the same one inside the picture."""
    image = picture(*size)
    out = degrade_image(image, parse_degradation("chat:45"), np.random.default_rng(5))
    (record,) = out.records
    assert record["size"] == [small[1], small[0]]
    assert 40 <= record["quality"] <= 70
    assert (out.low, out.jpeg) == (None, None)

    def resized(channels: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
        parts = [
            np.asarray(
                Image.fromarray(np.ascontiguousarray(channels[..., c])).resize(
                    (width, height), Image.Resampling.BICUBIC
                )
            )
            for c in range(3)
        ]
        return np.stack(parts, -1)

    shrunk = resized(image, *small)
    file = io.BytesIO()
    Image.fromarray(np.rint(shrunk.clip(0, 1) * 255).astype(np.uint8)).save(
        file, "JPEG", quality=record["quality"], subsampling="4:2:0"
    )
    expected = resized((np.asarray(Image.open(file)) / 255).astype(np.float32), *size)
    difference = np.abs(out.image - expected)[8:-8, 8:-8]
    assert difference.mean() < 2e-3
    assert out.image.shape == (*size, 3)


def test_a_messenger_does_not_enlarge_and_its_quality_varies() -> None:
    image, qualities = picture(32, 48), set()
    for seed in range(60):
        out = degrade_image(image, parse_degradation("chat:100"), np.random.default_rng(seed))
        qualities.add(out.records[0]["quality"])
        assert out.records[0]["size"] == [48, 32]
    assert min(qualities) >= 40
    assert max(qualities) <= 70
    assert len(qualities) > 20


def test_the_default_of_chat_is_half_of_the_longest_side() -> None:
    for height, width in ((80, 60), (60, 80)):
        out = degrade_image(picture(height, width), parse_degradation("chat"), np.random.default_rng(0))
        assert max(out.records[0]["size"]) == 40
    both = parse_degradation("lowres:2+chat").for_width(60, 80)
    assert str(both) == "lowres:2+chat:20"


# --- phone


def test_the_mosaic_is_rggb() -> None:
    image = np.arange(5 * 6 * 3, dtype=np.float64).reshape(5, 6, 3)
    mosaic = bayer_mosaic(image)
    for y in range(5):
        for x in range(6):
            channel = [[0, 1], [1, 2]][y % 2][x % 2]
            assert mosaic[y, x] == image[y, x, channel]


def test_demosaicing_keeps_what_was_measured_and_planes() -> None:
    """The filters are exact for a grey picture that is linear in x and y, away from the border."""
    y, x = np.mgrid[:14, :17] / 20.0
    grey = np.repeat((0.2 + 0.5 * x + 0.3 * y)[..., None], 3, -1)
    out = demosaic(bayer_mosaic(grey))
    np.testing.assert_allclose(out[2:-2, 2:-2], grey[2:-2, 2:-2], atol=1e-12)
    flat = demosaic(bayer_mosaic(np.broadcast_to([0.2, 0.5, 0.9], (9, 8, 3))))
    np.testing.assert_allclose(flat, np.broadcast_to([0.2, 0.5, 0.9], (9, 8, 3)), atol=1e-12)  # border too
    noise = np.random.default_rng(0).random((10, 11, 3))
    np.testing.assert_array_equal(bayer_mosaic(demosaic(bayer_mosaic(noise))), bayer_mosaic(noise))


def test_red_at_a_green_pixel_by_hand() -> None:
    """Malvar, He and Cutler's equation: the mean of the red neighbours and 5/8 of green's Laplacian."""
    mosaic = np.random.default_rng(1).random((9, 9))
    y, x = 4, 5  # green in a row of red
    m = mosaic
    laplacian = (
        m[y, x]
        - (m[y - 1, x - 1] + m[y - 1, x + 1] + m[y + 1, x - 1] + m[y + 1, x + 1] + m[y, x - 2] + m[y, x + 2])
        / 5
        + 0.1 * (m[y - 2, x] + m[y + 2, x])
    )
    expected = (m[y, x - 1] + m[y, x + 1]) / 2 + 5 / 8 * laplacian
    assert demosaic(mosaic)[y, x, 0] == pytest.approx(expected)


def test_denoising_lowers_noise_and_keeps_edges() -> None:
    white, rng = 375.0, np.random.default_rng(2)
    clean = np.full((60, 60, 3), 0.1)
    clean[:, 30:] = 0.8
    gains = np.array(WHITE_BALANCE)
    variance = gains * clean / white + (2.5 * gains / white) ** 2
    noisy = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    out = denoise(noisy, white)
    for part in (np.s_[5:-5, 5:22], np.s_[5:-5, 38:-5]):
        assert (out - clean)[part].std() < 0.5 * (noisy - clean)[part].std()
        assert abs((out - clean)[part].mean()) < 0.01
    step = out[:, 31:33, 1].mean() - out[:, 27:29, 1].mean()
    assert step > 0.9 * 0.7


def test_a_phone_is_unbiased_in_the_light_and_noisier_without() -> None:
    image, errors = np.full((80, 96, 3), 0.5, np.float32), []
    for stops in (0, 2, 4, 6):
        out = degrade_image(image, parse_degradation(f"phone:{stops}"), np.random.default_rng(stops))
        assert out.records == [{"kind": "phone", "value": stops, "electrons": 6000 / 2**stops}]
        assert abs((out.image - image).mean()) < 0.01
        errors.append((out.image - image).std())
    assert all(b > 1.5 * a for a, b in pairwise(errors[1:]))
    grain = (out.image - out.image.mean())[..., 1]
    neighbours = float(np.corrcoef(grain[:, 1:].ravel(), grain[:, :-1].ravel())[0, 1])
    assert neighbours > 0.2  # demosaicing and filtering leave no white noise


def test_a_phone_stores_a_jpeg_of_its_own() -> None:
    image = picture()
    out = degrade_image(image, parse_degradation("phone"), np.random.default_rng(1))
    assert out.jpeg is not None
    assert out.jpeg == phone_jpeg(image, 4, np.random.default_rng(1))
    with Image.open(io.BytesIO(out.jpeg)) as stored:
        np.testing.assert_array_equal(np.rint(out.image * 255), np.asarray(stored))
        assert stored.layer[1][1:3] == (1, 1)  # type: ignore[attr-defined]
        assert stored.layer[0][1:3] == (2, 2)  # type: ignore[attr-defined]  # 4:2:0
        reference = io.BytesIO()
        Image.new("RGB", (16, 16)).save(reference, "JPEG", quality=70)
        with Image.open(reference) as table:
            assert stored.quantization == table.quantization  # type: ignore[attr-defined]


# --- video


@pytest.mark.parametrize("size", [(45, 61), (48, 64)])
def test_a_film_comes_back(size: tuple[int, int]) -> None:
    pytest.importorskip("av")
    images = [picture(*size, shift=2.0 * k) for k in range(6)]
    frames = film(images, 10)
    assert [frame.image.shape for frame in frames] == [(*size, 3)] * 6
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(frame.image - image).mean() < 0.02
    assert frames[0].kind == "I"
    assert {frame.kind for frame in frames[1:]} <= {"P", "B"}
    assert frames[0].bytes > max(frame.bytes for frame in frames[1:])
    again = film(images, 10)
    for frame, same in zip(frames, again, strict=True):
        np.testing.assert_array_equal(frame.image, same.image)
        assert (frame.kind, frame.bytes) == (same.kind, same.bytes)
    coarse = film(images, 45)
    assert sum(f.bytes for f in coarse) < 0.5 * sum(f.bytes for f in frames)
    loss = [np.mean([np.square(f.image - i).mean() for f, i in zip(c, images, strict=True)])
            for c in (frames, coarse)]  # fmt: skip
    assert loss[1] > 4 * loss[0]


def test_a_film_has_the_same_bits_in_every_call() -> None:
    """Wherever its frames lie in memory; x264's vector code made another film of these in each call."""
    pytest.importorskip("av")
    rng = np.random.default_rng(0)
    photo = as_floats(clean_photo(0))
    corners = rng.integers(0, 28, (30, 2))
    images = [photo[y : y + 180, x + k : x + k + 152] for k, (y, x) in enumerate(corners)]
    held, films = list[np.ndarray](), set[bytes]()
    for _ in range(4):
        held.append(np.ones(int(rng.integers(1_000, 4_000_000)), np.uint8))
        films.add(b"".join(frame.image.tobytes() for frame in film(images, 36)))
    assert len(films) == 1


def test_colours_survive_a_film() -> None:
    """Flat colours have no detail to lose: what is left is rounding to 8 bits of limited range."""
    pytest.importorskip("av")
    for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (120, 64, 200)):
        image = np.broadcast_to(np.array(colour, np.float32) / 255, (34, 50, 3)).copy()
        (frame,) = film([image], 1)
        np.testing.assert_allclose(frame.image * 255, image * 255, atol=3)


def test_frames_of_several_sizes_are_refused() -> None:
    pytest.importorskip("av")
    images = [picture(45, 61), picture(46, 61)]
    with pytest.raises(
        ValueError, match="frames of one size, but there are photos of 61 x 45 and 61 x 46 px"
    ):
        degrade_sequence(images, parse_degradation("video"), [np.random.default_rng(0)] * 2, [None, None])


def test_without_pyav_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ValueError, match=r"video needs PyAV, the extra 'video': pip install 'hqgs\[video\]'"):
        degrade_image(picture(), parse_degradation("video"), np.random.default_rng(0))


def test_steps_before_and_after_a_film() -> None:
    pytest.importorskip("av")
    images = [picture(48, 64, shift=k) for k in range(3)]
    degradation = parse_degradation("some:blur:1+lowres:2+video:20+jpeg:60")
    out = degrade_sequence(
        images, degradation, [np.random.default_rng(k) for k in range(3)], [None, 1.5, None]
    )
    kinds = [[record["kind"] for record in photo.records] for photo in out]
    assert kinds[0] == kinds[2] == ["lowres", "video", "jpeg"]
    assert kinds[1] == ["blur", *kinds[0]]
    assert out[1].records[0]["value"] == 1.5
    for photo in out:
        assert photo.image.shape == (48, 64, 3)
        assert photo.low is not None
        assert photo.low.shape == (24, 32, 3)
        assert photo.jpeg is not None


# --- text


def test_defaults() -> None:
    text = "+".join(NEW)
    assert str(parse_degradation(text).for_width(504)) == ("shake:12+exposure:1+chat:252+phone:4+video:36")
    assert str(parse_degradation(text).for_width(252, 504)) == (
        "shake:6+exposure:1+chat:252+phone:4+video:36"
    )
    assert str(parse_degradation("some:shake").for_width(252)) == "some:shake:6"


def test_a_factor_scales_within_the_range() -> None:
    steps = parse_degradation("some:jpeg:90+some:noise:25+some:jpeg:1").steps
    assert [str(step.scaled(1.3)) for step in steps] == ["jpeg:95", "noise:32.5", "jpeg:1"]
    with pytest.raises(ValueError, match="some:shake has no value"):
        parse_degradation("some:shake").steps[0].scaled(1.0)


@pytest.mark.parametrize("kind", [*NOT_TOLD, "some:blur", "some:shake", "blur+chat"])
def test_a_method_cannot_be_told_of_these(kind: str) -> None:
    degradation = parse_degradation(kind)
    with pytest.raises(ValueError, match="cannot be corrected in the loss"):
        parse_formation(kind)
    with pytest.raises(
        ValueError, match="a formation consists of jpeg, noise, lowres, blur, defocus, motion"
    ):
        formation(degradation, 40, 50)
    assert str(parse_formation("blur+jpeg:10")) == "blur+jpeg:10"
    assert {k for k, v in KINDS.items() if not v.formation} == {*NOT_TOLD}


@pytest.mark.parametrize("kind", OWN)
def test_what_is_learned_takes_no_value(kind: str) -> None:
    assert str(parse_formation(f"{kind}+noise:5")) == f"{kind}+noise:5"
    assert formation(parse_formation(kind), 40, 50) is None
    with pytest.raises(ValueError, match=f"it is measured for each photo; write {kind}"):
        parse_formation(f"{kind}:2")
