"""Decoding, masks, order, and the area downscale against a slow direct computation."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from fixtures_photos import exif
from fixtures_scenes import HEIGHT, WIDTH, make_truth, write_colmap
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.files import decode, glance
from hqgs.photos.resize import area_downscale
from hqgs.scene.load import load_scene


def area_mean(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.float64]:
    """Mean over each new pixel's rectangle, pixel by pixel: overlap lengths as weights."""

    def overlap(old: int, new: int) -> NDArray[np.float64]:
        edges = np.arange(new + 1) * old / new
        cell = np.arange(old)
        return np.array(
            [
                np.clip(np.minimum(b, cell + 1) - np.maximum(a, cell), 0, None)
                for a, b in itertools.pairwise(edges)
            ]
        )

    rows, columns = overlap(image.shape[0], height), overlap(image.shape[1], width)
    total = np.einsum("ij,jkc,lk->ilc", rows, image.astype(np.float64), columns)
    return total * height * width / (image.shape[0] * image.shape[1])


@pytest.mark.parametrize(("width", "height"), [(24, 18), (16, 12), (20, 15), (19, 11), (47, 35), (8, 9)])
def test_area_downscale(width: int, height: int) -> None:
    image = make_truth(1).photos[0]
    small, mask = area_downscale(image, None, width, height)
    assert mask is None
    assert small.dtype == np.uint8
    expected = area_mean(image, width, height)
    assert np.abs(small - expected).max() <= 0.5 + 1e-9


def test_area_downscale_keeps_ramps_in_place() -> None:
    """A ramp's mean is its value at the centre, so a shift by part of a pixel would show."""
    ramp = np.repeat(np.arange(0, 240, 5, dtype=np.uint8)[None, :, None], 30, 0).repeat(3, -1)
    small, _ = area_downscale(ramp, None, 20, 30)
    centers = (np.arange(20) + 0.5) * 48 / 20
    assert np.abs(small[0, :, 0] - 5 * (centers - 0.5)).max() <= 1.0


def test_masked_downscale_does_not_mix_in_what_is_hidden() -> None:
    image = np.full((36, 48, 3), 255, np.uint8)
    mask = np.zeros((36, 48), bool)
    mask[:, :21] = True
    image[:, :21] = 40
    small, share = area_downscale(image, mask, 12, 9)
    assert share is not None
    expected = np.zeros((9, 12), bool)
    expected[:, :5] = True  # columns 0..19, and a quarter of 20..23, which is not half
    np.testing.assert_array_equal(share, expected)
    assert (small[:, :6] == 40).all()
    assert (small[:, 6:] == 255).all()


def test_half_tones_and_16_bits(tmp_path: Path) -> None:
    grey16 = np.linspace(0, 65535, 16 * 20).astype(np.uint16).reshape(16, 20)
    Image.fromarray(grey16).save(tmp_path / "a.png")
    rgb, mask = decode(tmp_path / "a.png")
    assert mask is None
    np.testing.assert_array_equal(rgb, np.rint(grey16 / 257)[..., None].astype(np.uint8).repeat(3, -1))
    Image.fromarray(grey16).save(tmp_path / "e.png", transparency=int(grey16[3, 4]))
    shown, mask = decode(tmp_path / "e.png")
    np.testing.assert_array_equal(shown, rgb)
    assert mask is not None
    assert np.argwhere(~mask).tolist() == [[3, 4]]
    mixed = decode(tmp_path / "e.png", over=(0, 0, 0))[0]
    assert mixed[3, 4].tolist() == [0, 0, 0, 255]
    np.testing.assert_array_equal(mixed[4:, :, :3], rgb[4:])
    assert not mixed[4:, :, 3].any()
    grey8 = (grey16 >> 8).astype(np.uint8)
    Image.fromarray(grey8).save(tmp_path / "b.png")
    np.testing.assert_array_equal(decode(tmp_path / "b.png")[0], grey8[..., None].repeat(3, -1))
    Image.fromarray(grey8 > 99).save(tmp_path / "c.png")
    np.testing.assert_array_equal(decode(tmp_path / "c.png")[0][..., 1], (grey8 > 99) * 255)
    Image.fromarray(grey8.astype(np.float32)).save(tmp_path / "d.tif")
    with pytest.raises(ValueError, match=r"d\.tif: pixels are floating-point"):
        decode(tmp_path / "d.tif")


def test_alpha(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rgba = rng.integers(0, 256, (16, 20, 4), dtype=np.uint8)
    Image.fromarray(rgba).save(tmp_path / "a.png")
    rgb, mask = decode(tmp_path / "a.png")
    np.testing.assert_array_equal(rgb, rgba[..., :3])
    np.testing.assert_array_equal(mask, rgba[..., 3] >= 128)
    rgba[..., 3] = 255
    Image.fromarray(rgba).save(tmp_path / "b.png")
    assert decode(tmp_path / "b.png")[1] is None
    palette = Image.fromarray((np.arange(320).reshape(16, 20) % 3).astype(np.uint8)).convert("P")
    palette.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90])
    palette.save(tmp_path / "c.png", transparency=1)
    rgb, mask = decode(tmp_path / "c.png")
    np.testing.assert_array_equal(mask, np.arange(320).reshape(16, 20) % 3 != 1)
    np.testing.assert_array_equal(rgb[0, :3], [[10, 20, 30], [40, 50, 60], [70, 80, 90]])


def test_exif_orientation_is_left_alone(tmp_path: Path) -> None:
    photo = np.zeros((16, 24, 3), np.uint8)
    photo[:, 12:] = 255
    Image.fromarray(photo).save(tmp_path / "a.png", exif=exif(6))  # "turn by 90 degrees to show"
    np.testing.assert_array_equal(decode(tmp_path / "a.png")[0], photo)


@pytest.mark.filterwarnings("ignore:Truncated File Read")  # Pillow says so before it raises
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_truncated_photo_names_the_file(tmp_path: Path, suffix: str, share: float) -> None:
    write_colmap(make_truth(3, suffix), tmp_path)
    path = tmp_path / f"images/view_01{suffix}"
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=rf"cannot read the photo .*view_01\{suffix}"):
        load_scene(tmp_path)


def test_broken_mask_names_the_file(tmp_path: Path) -> None:
    write_colmap(make_truth(3), tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/view_02.png").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"cannot read the mask .*view_02\.png"):
        load_scene(tmp_path)


def test_mask_file_and_alpha_both_count(tmp_path: Path) -> None:
    truth = make_truth(1)
    write_colmap(truth, tmp_path)
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:10] = 0
    Image.fromarray(np.dstack([truth.photos[0], alpha])).save(tmp_path / "images/view_00.png")
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :10] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/view_00.png")
    view = load_scene(tmp_path, test_every=0).train[0]
    assert view.mask is not None
    np.testing.assert_array_equal(view.mask, (alpha > 0) & (mask > 0))
    small = load_scene(tmp_path, downscale=2, test_every=0).train[0]
    np.testing.assert_array_equal(small.mask, ((alpha > 0) & (mask > 0))[::2, ::2])


def test_order_is_kept_over_many_photos(tmp_path: Path) -> None:
    """More photos than workers, each of its own colour."""
    truth = make_truth(24)
    for i, photo in enumerate(truth.photos):
        photo[:] = 10 * i
    scene = load_scene(write_colmap(truth, tmp_path), test_every=0)
    assert [int(v.image[0, 0, 0]) for v in scene.train] == [10 * i for i in range(24)]
    again = load_scene(tmp_path, test_every=0)
    for a, b in zip(scene.train, again.train, strict=True):
        np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.parametrize("size", [(1, 1), (6, 40), (7, 7)])
def test_a_glance_at_the_smallest_jpeg(tmp_path: Path, size: tuple[int, int]) -> None:
    Image.new("L", size, 128).save(tmp_path / "a.jpg")
    seen = glance(tmp_path / "a.jpg")
    assert (seen.size, seen.format) == (size, "JPEG")
    assert np.ptp(seen.small) == 0
