"""Decoding, masks, order, the area downscale against a slow direct computation, and what cannot be read."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from fixtures_photos import exif
from fixtures_scenes import HEIGHT, WIDTH, make_truth, write_colmap, write_llff, write_transforms
from numpy.typing import NDArray
from PIL import Image

from hqgs.photos.files import decode, glance
from hqgs.photos.formula import parse_degradation
from hqgs.photos.resize import area_downscale
from hqgs.scene.degrade import write_degraded_scene
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


# --- Training photos that cannot be read: left out on request, without any other change to the scene


pytestmark = pytest.mark.filterwarnings("ignore:Truncated File Read")  # Pillow says so before it raises


def spoil(*paths: Path, share: float = 0.5) -> None:
    for path in paths:
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])


def names(root: Path, skip: bool = True) -> tuple[list[str], list[str]]:
    scene = load_scene(root, skip_unreadable=skip)
    return [view.name for view in scene.train], [view.name for view in scene.test]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("longest", [None, 32])
def test_training_photos_are_skipped_and_named(
    tmp_path: Path, share: float, suffix: str, longest: int | None
) -> None:
    """The test views stay those of the whole folder: views 0 and 8 of 10, although 3 and 5 are gone."""
    truth = make_truth(10, suffix)
    whole = load_scene(write_colmap(truth, tmp_path), longest=longest)
    spoil(tmp_path / f"images/view_03{suffix}", tmp_path / f"images/view_05{suffix}", share=share)
    scene = load_scene(tmp_path, skip_unreadable=True, longest=longest)
    gone = {f"view_03{suffix}", f"view_05{suffix}"}
    left = [view for view in whole.train if view.name not in gone]
    assert [view.name for view in scene.train] == [view.name for view in left]
    assert [view.name for view in scene.test] == [f"view_00{suffix}", f"view_08{suffix}"]
    for view, before in zip(scene.train, left, strict=True):
        np.testing.assert_array_equal(view.image, before.image)
        np.testing.assert_array_equal(view.camera.viewmat, before.camera.viewmat)
    told = 0 if longest is None else 1  # how many photos are scaled down: of those that can be opened
    assert scene.notes[told:-1] == whole.notes[told:]
    assert scene.notes[-1].startswith(
        f"2 of 8 training photos cannot be used and were left out: view_03{suffix}, view_05{suffix}. The "
        "first: cannot read the photo "
    )
    with pytest.raises(ValueError, match=rf"cannot read the photo .*view_03\{suffix}"):
        load_scene(tmp_path, longest=longest)


def test_nothing_to_skip_changes_nothing(tmp_path: Path) -> None:
    write_colmap(make_truth(9), tmp_path)
    assert load_scene(tmp_path, skip_unreadable=True).notes == load_scene(tmp_path).notes
    assert names(tmp_path) == names(tmp_path, skip=False)


@pytest.mark.parametrize(("gone", "readable"), [(4, True), (5, False)])
def test_half_must_remain(tmp_path: Path, gone: int, readable: bool) -> None:
    """Of 8 training photos among 10; the error is that of the first one, as without the option."""
    write_colmap(make_truth(10), tmp_path)
    spoil(*(tmp_path / f"images/view_{k:02d}.png" for k in range(2, 2 + gone)))
    if readable:
        assert names(tmp_path)[0] == ["view_01.png", "view_06.png", "view_07.png", "view_09.png"]
        return
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_02\.png"):
        load_scene(tmp_path, skip_unreadable=True)


def test_held_out_photos_are_left_out_while_one_remains(tmp_path: Path) -> None:
    write_colmap(make_truth(10), tmp_path)
    spoil(tmp_path / "images/view_08.png", tmp_path / "images/view_03.png")
    scene = load_scene(tmp_path, skip_unreadable=True)
    assert [view.name for view in scene.test] == ["view_00.png"]
    assert any(note.startswith("1 of 2 held-out photos cannot be used") for note in scene.notes)
    spoil(tmp_path / "images/view_00.png")
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_00\.png"):
        load_scene(tmp_path, skip_unreadable=True)


def test_a_photo_of_another_shape_is_left_out(tmp_path: Path) -> None:
    write_colmap(make_truth(4), tmp_path)
    Image.new("RGB", (30, 60)).save(tmp_path / "images/view_01.png")
    scene = load_scene(tmp_path, skip_unreadable=True)
    assert [view.name for view in scene.train] == ["view_02.png", "view_03.png"]
    assert "view_01.png' is 30 x 60, but its camera is for 48 x 36: another aspect ratio" in scene.notes[-1]
    with pytest.raises(ValueError, match=r"view_01\.png' is 30 x 60, but its camera is for"):
        load_scene(tmp_path)


def test_mask(tmp_path: Path) -> None:
    """A photo is not trained on without its mask."""
    write_colmap(make_truth(4), tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/view_02.png").write_bytes(b"nothing")
    assert names(tmp_path) == (["view_01.png", "view_03.png"], ["view_00.png"])


def test_transforms_without_size(tmp_path: Path) -> None:
    """The size stands in the photo alone, so that reading the cameras meets the photo first."""
    write_transforms(make_truth(10), tmp_path, w=None, h=None)
    spoil(tmp_path / "images/view_05.png", share=0.0)
    train, test = names(tmp_path)
    assert test == ["images/view_00.png", "images/view_08.png"]
    assert train == [f"images/view_{k:02d}.png" for k in (1, 2, 3, 4, 6, 7, 9)]
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_05\.png"):
        load_scene(tmp_path)
    spoil(tmp_path / "images/view_00.png", share=0.0)
    assert names(tmp_path) == (train, ["images/view_08.png"])


def test_marker_counts_the_photos_in_the_folder(tmp_path: Path) -> None:
    write_llff(make_truth(10), tmp_path)
    (tmp_path / "hold=3").touch()
    spoil(tmp_path / "images/view_01.png")
    train, test = names(tmp_path)
    assert test == [f"view_{k:02d}.png" for k in (0, 3, 6, 9)]
    assert train == [f"view_{k:02d}.png" for k in (2, 4, 5, 7, 8)]


def test_small_photo(tmp_path: Path) -> None:
    scene = load_scene(write_colmap(make_truth(10), tmp_path / "clean"))
    write_degraded_scene(scene, tmp_path / "low", parse_degradation("lowres:2"), seed=0)
    spoil(tmp_path / "low/low/view_05.png", tmp_path / "low/images/view_06.png")
    train, test = names(tmp_path / "low")
    assert test == ["view_00.png", "view_08.png"]
    assert train == [f"view_{k:02d}.png" for k in (1, 2, 3, 4, 7, 9)]
    with pytest.raises(ValueError, match=r"cannot read the photo .*view_06\.png"):
        load_scene(tmp_path / "low")


def test_cut_out_photos_stay_cut_out(tmp_path: Path) -> None:
    """A photo that cannot be opened does not make masks of the transparency of all others."""
    truth = make_truth(5)
    write_colmap(truth, tmp_path)
    alpha = np.full((36, 48), 255, np.uint8)
    alpha[:, :24] = 0
    for name, photo in zip(truth.names, truth.photos, strict=True):
        Image.fromarray(np.dstack([photo, alpha])).save(tmp_path / "images" / name)
    (tmp_path / "images/view_02.png").write_bytes(b"")
    scene = load_scene(tmp_path, test_every=0, skip_unreadable=True)
    assert len(scene.train) == 4
    assert all(view.mask is None and view.empty is not None for view in scene.train)
