"""Masks: found by every name that tools give them, in every place, and turned as their photo is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures_photos import exif, looked_at
from fixtures_scenes import Truth, make_truth, write_colmap, write_llff, write_photos, write_transforms
from numpy.typing import NDArray
from PIL import Image, ImageOps

from hqgs.photos.exif import read_exif
from hqgs.photos.pixels import oriented
from hqgs.scene.load import load_scene
from hqgs.scene.masks import masks_of
from hqgs.scene.photo_files import masks_among

NAMES = [
    "{stem}.png.mask.png", "{stem}.mask.png", "{stem}-mask.png", "{stem}_mask.png", "mask.{stem}.png",
    "mask_{stem}.png", "mask-{stem}.png", "{stem}_MASK.PNG", "{stem}.png_mask.jpg", "{stem}_masks.webp",
    "mask_{stem}.png.png", "{stem} mask.png",
    "{stem}.matte.png", "{stem}_alpha.png", "{stem}_sam_mask.png", "{stem}_msk.png",
]  # fmt: skip
IN_FOLDERS = [*NAMES, "{stem}.png", "{stem}.png.png", "{stem}.jpg"]


def left_half(photo: NDArray[np.uint8]) -> Image.Image:
    mask = np.zeros(photo.shape[:2], np.uint8)
    mask[:, : photo.shape[1] // 2] = 255
    return Image.fromarray(mask)


def put(truth: Truth, folder: Path, pattern: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, photo in zip(truth.names, truth.photos, strict=True):
        left_half(photo).save(folder / pattern.format(stem=Path(name).stem))


@pytest.mark.parametrize("pattern", IN_FOLDERS)
@pytest.mark.parametrize("write", [write_colmap, write_transforms, write_llff])
def test_every_name_in_a_folder_of_masks(tmp_path: Path, pattern: str, write) -> None:
    truth = make_truth(5)
    write(truth, tmp_path)
    put(truth, tmp_path / "masks", pattern)
    scene = load_scene(tmp_path, test_every=0)
    assert any(note.startswith("5 of 5 photos have a mask, such as ") for note in scene.notes)
    for view in scene.train:
        assert view.mask is not None
        assert view.mask[:, :24].all()
        assert not view.mask[:, 24:].any()


@pytest.mark.parametrize("folder", ["Mask", "images_masks", "image-mask", "sam2_masks", "mattes"])
def test_folders_of_masks(tmp_path: Path, folder: str) -> None:
    truth = make_truth(5)
    write_colmap(truth, tmp_path)
    put(truth, tmp_path / folder, "{stem}.png")
    for view in load_scene(tmp_path, test_every=0).train:
        assert view.mask is not None
        assert view.mask.mean() == 0.5


@pytest.mark.parametrize("pattern", NAMES)
@pytest.mark.parametrize("kind", ["colmap", "transforms", "llff", "bare", "bare in images"])
def test_every_name_beside_the_photos(tmp_path: Path, pattern: str, kind: str) -> None:
    """They are no photos, whatever reads the folder."""
    truth = make_truth(5)
    if kind.startswith("bare"):
        folder = tmp_path / "images" if "images" in kind else tmp_path
        write_photos(truth, folder)
        put(truth, folder, pattern)
        photos = looked_at(tmp_path)
        assert photos.names == truth.names
        assert len(masks_of(tmp_path, photos.folder, photos.names)) == 5
        return
    {"colmap": write_colmap, "transforms": write_transforms, "llff": write_llff}[kind](truth, tmp_path)
    put(truth, tmp_path / "images", pattern)
    scene = load_scene(tmp_path, test_every=0)
    assert [view.name.removeprefix("images/") for view in scene.train] == truth.names
    assert all(view.mask is not None and view.mask.mean() == 0.5 for view in scene.train)
    assert not any("have no camera" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("photo", "mask", "found"),
    [
        ("cam0/1.jpg", "masks/cam0/1.png", True),
        ("cam0/1.jpg", "cam0/masks/1.png", True),
        ("cam0/1.jpg", "masks/1.png", True),
        ("cam0/1.jpg", "cam0/1.jpg.mask.png", True),
        ("cam0/1.jpg", "Masks/images/cam0/1.png", True),
        ("cam0/1.jpg", "cam1/1.mask.png", False),
        ("gas_mask.jpg", "masks/gas_mask.png", True),
        ("gas_mask.jpg", "masks/gas_mask_mask.png", True),
        ("1.jpg", "masks/11.png", False),
        ("1.jpg", "unmasked_1.png", False),
        ("mask.jpg", "masks/mask.png", True),
    ],
)
def test_a_mask_belongs_to_one_photo(tmp_path: Path, photo: str, mask: str, found: bool) -> None:
    for name in (photo, mask):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (8, 8)).save(tmp_path / name)
    masks = masks_of(tmp_path, tmp_path, [photo])
    assert masks == ({photo: tmp_path / mask} if found else {})


@pytest.mark.parametrize("place", ["walk/masks", "Masks", "walk"])
def test_masks_lie_beside_the_photos_or_above(tmp_path: Path, place: str) -> None:
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / "walk").mkdir(exist_ok=True)
    for name in ("walk/0.png", f"{place}/0_mask.PNG"):
        Image.new("L", (8, 8)).save(tmp_path / name)
    assert masks_of(tmp_path, tmp_path / "walk", ["0.png"]) == {"0.png": tmp_path / place / "0_mask.PNG"}


def test_masks_of_photos_that_are_called_alike(tmp_path: Path) -> None:
    names = ["cam0/1.jpg", "cam1/1.jpg", "2.jpg", "2.png"]
    for name in ("masks/1.png", "masks/2.jpg.png", "masks/2.png.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("L", (8, 8)).save(tmp_path / name)
    found = masks_of(tmp_path, tmp_path, names)
    assert {name: path.name for name, path in found.items()} == {"2.jpg": "2.jpg.png", "2.png": "2.png.png"}


def test_photos_that_are_called_like_masks_stay() -> None:
    names = [
        "gas_mask.jpg",
        "mask_of_clay.jpg",
        "mask.1.jpg",
        "2.jpg",
        "2_mask.jpg",
        "masks/2.png",
        "mask.jpg",
    ]
    assert masks_among(names) == {"2_mask.jpg", "masks/2.png"}


def test_a_mask_whose_photo_is_gone_is_no_photo() -> None:
    names = ["1.jpg", "1.jpg.mask.png", "2.jpg", "2.jpg.mask.png", "3.jpg.mask.png", "mask_4.png"]
    assert masks_among(names) == {"1.jpg.mask.png", "2.jpg.mask.png", "3.jpg.mask.png"}


def scene_turned(root: Path, orientation: int, shown: bool, size: tuple[int, int]) -> Truth:
    """A model for photos as they are stored; a bright thing in the dark, and its mask as a tool makes it of
    the photo upright (Pillow's `exif_transpose`), or as it is stored."""
    truth = make_truth(4, ".jpg")
    width, height = size
    truth = Truth(truth.names, truth.viewmats, truth.photos, truth.points, truth.colors,
                  params=[40.0, 40.0, width / 2, height / 2], width=width, height=height)  # fmt: skip
    write_colmap(truth, root, images=None)
    (root / "images").mkdir()
    (root / "masks").mkdir()
    thing = np.zeros((height, width), np.uint8)
    thing[4 : height // 2, 6 : width // 4] = 255
    for name in truth.names:
        grey = np.repeat(thing[..., None] // 2 + 40, 3, -1)
        Image.fromarray(grey).save(root / "images" / name, exif=exif(orientation))
        mask = Image.fromarray(thing)
        if shown:
            mask.getexif()[0x0112] = orientation
            with Image.open(root / "images" / name) as photo:
                seen = ImageOps.exif_transpose(photo)
            mask = seen.convert("L").point([255 * (level > 100) for level in range(256)])
        mask.save(root / "masks" / f"{name}.mask.png")
    return truth


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("shown", [False, True])
@pytest.mark.parametrize("size", [(64, 48), (48, 48)])
def test_masks_of_photos_that_are_turned(
    tmp_path: Path, orientation: int, shown: bool, size: tuple[int, int]
) -> None:
    scene_turned(tmp_path, orientation, shown, size)
    scene = load_scene(tmp_path, test_every=0)
    for view in scene.train:
        assert view.mask is not None
        bright = view.image.mean(-1) > 100
        assert (view.mask == bright).mean() > 0.98
    told = [note for note in scene.notes if "rotated by EXIF" in note]
    assert len(told) == (orientation > 1 and (orientation < 5 or size[0] == size[1]))
    assert all("as edges in the photos show" in note for note in told)


def test_where_nothing_tells_how_masks_lie_that_is_said(tmp_path: Path) -> None:
    truth = scene_turned(tmp_path, 3, True, (64, 48))
    for name in truth.names:
        Image.new("RGB", (64, 48), "grey").save(tmp_path / "images" / name, exif=exif(3))
    scene = load_scene(tmp_path, test_every=0)
    assert any("as they are stored, though that is not certain: check them" in note for note in scene.notes)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_are_those_of_pillow(tmp_path: Path, orientation: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (6, 9, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif(orientation))
    with Image.open(tmp_path / "a.png") as photo:
        shown = np.asarray(ImageOps.exif_transpose(photo))
    np.testing.assert_array_equal(oriented(pixels, orientation), shown)
    back = {6: 8, 8: 6}.get(orientation, orientation)
    np.testing.assert_array_equal(oriented(shown, back), pixels)
    assert read_exif(tmp_path / "a.png").orientation == orientation


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_cameras_of_photos_as_exif_shows_them(tmp_path: Path, orientation: int) -> None:
    """The photo lies on its side in its file, and is mirrored in 5 and 7; model and mask are upright."""
    truth = make_truth(4)
    write_colmap(truth, tmp_path, images=None)
    (tmp_path / "images").mkdir()
    back = {6: 8, 8: 6}.get(orientation, orientation)
    for name, photo in zip(truth.names, truth.photos, strict=True):
        Image.fromarray(oriented(photo, back)).save(tmp_path / "images" / name, exif=exif(orientation))
    put(truth, tmp_path / "masks", "{stem}.png")
    scene = load_scene(tmp_path, test_every=0)
    for view, photo in zip(scene.train, truth.photos, strict=True):
        np.testing.assert_array_equal(view.image, photo)
        assert view.quarter_turns == 0
        assert view.mask is not None
        assert view.mask[:, :24].all()
        assert not view.mask[:, 24:].any()
    upright = load_scene(write_colmap(truth, tmp_path / "upright"), downscale=2, test_every=0)
    for view, small in zip(load_scene(tmp_path, downscale=2, test_every=0).train, upright.train, strict=True):
        np.testing.assert_array_equal(view.image, small.image)


def test_photos_upside_down_go_as_those_on_their_side(tmp_path: Path) -> None:
    """Shapes tell of 6 and 8 that cameras are those of photos as EXIF shows them; of 3 they do not."""
    truth = make_truth(4)
    write_colmap(truth, tmp_path, images=None)
    (tmp_path / "images").mkdir()
    for name, photo, number in zip(truth.names, truth.photos, (1, 6, 3, 8), strict=True):
        stored = oriented(photo, {6: 8, 8: 6}.get(number, number))
        Image.fromarray(stored).save(tmp_path / "images" / name, exif=exif(number))
    for view, photo in zip(load_scene(tmp_path, test_every=0).train, truth.photos, strict=True):
        np.testing.assert_array_equal(view.image, photo)
        assert view.quarter_turns == 0
