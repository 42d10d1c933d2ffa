"""Folders of photos as people have them: what is a photo, copies, suffixes, other programs, GPS."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_cards import HEIGHT, WIDTH
from fixtures_photos import exif, looked_at, picture
from fixtures_scenes import make_truth, write_colmap, write_transforms
from PIL import Image, ImageDraw, features

from hqgs.base.stages import Stage
from hqgs.photos.exif import read_exif
from hqgs.photos.files import LARGEST, UnreadableError, decode, decode_mask, glance
from hqgs.scene.checks import elsewhere
from hqgs.scene.film import check_film, frame_details
from hqgs.scene.load import load_scene
from hqgs.scene.names import existing_folder
from hqgs.scene.photo_files import film_at
from hqgs.scene.sfm.folder import write_colmap_folder
from hqgs.scene.source import load, pictures


def test_of_copies_one_is_used_and_the_others_are_named(tmp_path: Path) -> None:
    for k in range(3):
        picture(k, (64, 64)).save(tmp_path / f"IMG_{k}.jpg", exif=exif(1, 28, "Phone"))
    shutil.copy(tmp_path / "IMG_1.jpg", tmp_path / "IMG_1 (1).jpg")
    shutil.copy(tmp_path / "IMG_2.jpg", tmp_path / "WhatsApp.jpg")
    picture(3).save(tmp_path / "close.png")
    changed = picture(3)
    changed.putpixel((4, 5), (1, 2, 3))
    changed.save(tmp_path / "closer.png")
    stages: list[Stage] = []
    photos = looked_at(tmp_path, stages.append)
    assert photos.names == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg", "close.png", "closer.png"]
    assert len(photos.sizes) == len(photos.exif) == 5
    assert photos.notes == [
        "5 photos, cameras in EXIF: 1 (of 3 photos), 2 duplicates not used",
        "2 of 7 photos are duplicates and are not used: IMG_1 (1).jpg (of IMG_1.jpg), "
        "WhatsApp.jpg (of IMG_2.jpg)",
    ]
    assert stages[-1].note == photos.notes[0]


def test_of_versions_of_a_photo_one_is_used_and_other_photos_by_such_names_stay(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    coarse = [Image.fromarray(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)) for _ in range(3)]
    first, second, third = (small.resize((400, 300), Image.Resampling.BICUBIC) for small in coarse)
    first.save(tmp_path / "IMG_0001.jpg")
    first.save(tmp_path / "IMG_0001.webp", quality=60)
    first.point(lambda value: value * 0.8).save(tmp_path / "IMG_E0001.jpg")
    first.resize((200, 150)).save(tmp_path / "IMG_0001_small.png")
    first.save(tmp_path / "IMG_0001.heic.jpg")  # of a converter that keeps the suffix
    second.save(tmp_path / "IMG_0002.jpg")
    third.save(tmp_path / "IMG_0002 (1).jpg")
    photos = looked_at(tmp_path)
    assert photos.names == ["IMG_0001.jpg", "IMG_0002 (1).jpg", "IMG_0002.jpg"]
    assert any("IMG_0001.heic.jpg (of IMG_0001.jpg)" in note for note in photos.notes)


def test_photos_deeper_than_those_that_are_used_are_told(tmp_path: Path) -> None:
    for k, folder in enumerate(("one", "one", "two/inner")):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        picture(k).save(tmp_path / folder / f"{k}.png")
    photos = looked_at(tmp_path)
    assert photos.names == ["0.png", "1.png"]
    assert any(note.startswith("not used: photos in two/inner (1). Put") for note in photos.notes)


def test_frames_of_a_film_that_stands_still_all_stay(tmp_path: Path) -> None:
    for k in range(3):
        picture(0).save(tmp_path / f"{k}.png")
    assert looked_at(tmp_path).names == ["0.png"]
    for theirs in ("[]", '{"fps": 30}'):  # of another program
        (tmp_path / "frames.json").write_text(theirs)
        assert looked_at(tmp_path).names == ["0.png"]
        assert frame_details(tmp_path) == {}
    (tmp_path / "frames.json").write_text('{"details": {}}')
    assert looked_at(tmp_path).names == ["0.png", "1.png", "2.png"]


def test_folders_that_cannot_be_listed_are_passed_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A card's lost+found, and a shared disk above the photos. (The system lets root list all.)"""
    root, access = tmp_path / "card", os.access
    (root / "lost+found").mkdir(parents=True)
    for k in range(3):
        picture(k).save(root / f"{k}.png")
    closed = {str(root / "lost+found"), str(tmp_path)}
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) not in closed and access(path, mode))
    iterdir = Path.iterdir

    def listed(path: Path) -> Iterator[Path]:
        if str(path) in closed:
            raise PermissionError(13, "Permission denied", str(path))
        return iterdir(path)

    monkeypatch.setattr(Path, "iterdir", listed)
    assert looked_at(root).names == ["0.png", "1.png", "2.png"]
    assert elsewhere(root) == []


def test_photos_in_folders_below_others_are_told(tmp_path: Path) -> None:
    for name in ("copy", "more", "masks"):
        (tmp_path / name).mkdir()
    for k in range(3):
        picture(k).save(tmp_path / f"{k}.jpg")
    for name in ("copy", "more"):
        shutil.copy(tmp_path / "0.jpg", tmp_path / name / "x.jpg")
    picture(5).save(tmp_path / "more" / "new.jpg")
    picture(5).save(tmp_path / "masks" / "0.png")
    assert looked_at(tmp_path).notes == [
        "3 photos, no camera in EXIF",
        "not used: photos in copy (1), more (2). Put all photos of one scene into one folder to use them",
    ]
    for k in range(3):
        (tmp_path / f"{k}.jpg").unlink()
    assert looked_at(tmp_path).names == ["copy/x.jpg", "more/new.jpg"]


@pytest.mark.parametrize(
    ("tags", "wanted"),
    [
        (
            {1: "N", 2: (48.0, 30.0, 18.0), 3: "E", 4: (9.0, 3.0, 36.0), 5: b"\0", 6: 321.5},
            (48.505, 9.06, 321.5),
        ),
        ({1: "S", 2: (1.0, 0.0, 0.0), 3: "W", 4: (2.0, 0.0, 0.0), 5: b"\1", 6: 3.0}, (-1, -2, -3)),
        ({1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)}, None),  # no fix
        ({1: "N", 2: (95.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 1.0)}, None),
        ({1: "N", 2: (5.0, 0.0, 0.0)}, None),
        ({1: "N", 2: (5.0, 0.0, 0.0), 3: "E", 4: (6.0, 0.0, 0.0)}, (5, 6, np.nan)),  # no altitude
    ],
)
def test_exif_tells_the_place(
    tags: dict[int, object], wanted: tuple[float, float, float] | None, tmp_path: Path
) -> None:
    picture(0).save(tmp_path / "a.jpg", exif=exif(gps=tags))
    found = read_exif(tmp_path / "a.jpg").gps
    assert found == (None if wanted is None else pytest.approx(wanted, abs=1e-9, nan_ok=True))


def test_masks_are_looked_at_before_colmap_works(tmp_path: Path) -> None:
    photos, heard = tmp_path / "set", list[Stage]()
    (photos / "masks").mkdir(parents=True)
    for k in range(4):
        picture(k, (64, 48)).save(photos / f"{k}.png")
    Image.new("L", (48, 64), 255).save(photos / "masks" / "2.png")
    with pytest.raises(ValueError, match=r"2\.png is 48 x 64, its photo 64 x 48: another aspect ratio"):
        load_scene(photos, keep_sfm=tmp_path / "sfm", on_stage=heard.append)
    assert {stage.what for stage in heard} == {"photos read"}
    assert not (tmp_path / "sfm").exists()


def test_photos_without_a_mask_are_named_where_others_have_one(tmp_path: Path) -> None:
    truth = make_truth(4)
    write_transforms(truth, tmp_path)
    (tmp_path / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(tmp_path / "masks" / "other.png")
    notes = load_scene(tmp_path).notes
    assert "masks are in masks, but are not used, as none has the name of a photo" in notes
    Image.new("L", (48, 36), 255).save(tmp_path / "masks" / truth.names[0])
    notes = load_scene(tmp_path).notes
    assert any(
        note.startswith("1 of 4 photos have a mask, such as ")
        and "these have none, so all their pixels count" in note
        for note in notes
    )


def test_frames_are_asked_of_films_alone(tmp_path: Path) -> None:
    picture(0).save(tmp_path / "a.png")
    for ask in (
        lambda: load(tmp_path, frames=9),
        lambda: write_colmap_folder(tmp_path, tmp_path, tmp_path, 9),
    ):
        with pytest.raises(ValueError, match=r"frames is for films, and .* is not a film"):
            ask()
    with pytest.raises(ValueError, match="frames is for films"):
        load("embedded", frames=9)


def test_a_look_at_photos_without_poses_is_of_the_size_that_a_run_takes(tmp_path: Path) -> None:
    for k in range(3):
        picture(k, (400, 300)).save(tmp_path / f"{k}.png")
    assert {view.image.shape for view in pictures(tmp_path, longest=200).train} == {(150, 200, 3)}
    assert {view.image.shape for view in pictures(tmp_path).train} == {(300, 400, 3)}


# --- Folders of photos as people have them: what is a photo, and what of a folder is not read


def fill(folder: Path, count: int = 3, first: int = 0, suffix: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(first, first + count):
        picture(k, (64, 48)).save(folder / f"{k}{suffix}")


@pytest.mark.parametrize("inner", ["DCIM/100APPLE", "Takeout/Google Photos/Walk", "a/b/c/d/e"])
def test_photos_far_down_are_found_and_the_folder_is_named(inner: str, tmp_path: Path) -> None:
    fill(tmp_path / inner)
    (tmp_path / "__MACOSX" / inner).mkdir(parents=True)
    (tmp_path / "__MACOSX" / inner / "._0.png").write_bytes(b"no picture")
    photos = looked_at(tmp_path)
    assert (photos.folder, photos.names) == (tmp_path / inner, ["0.png", "1.png", "2.png"])
    assert f"the photos are those in {inner}, below {tmp_path.name}" in photos.notes


def test_maps_beside_photos_are_no_photos(tmp_path: Path) -> None:
    fill(tmp_path / "rgb")
    for k, name in enumerate(("depth", "Confidence", "normal_maps", "thumbs")):
        fill(tmp_path / name, first=10 * k)
    photos = looked_at(tmp_path)
    assert photos.folder == tmp_path / "rgb"
    told = "their names say that they hold no photos: Confidence, depth, normal_maps, thumbs"
    assert any(note.endswith(told) for note in photos.notes)
    shutil.rmtree(tmp_path / "rgb")  # what else is there is all that can be meant
    assert len(looked_at(tmp_path).names) == 12


def test_an_empty_folder_of_images_hides_no_photos(tmp_path: Path) -> None:
    fill(tmp_path)
    (tmp_path / "images").mkdir()
    assert looked_at(tmp_path).names == ["0.png", "1.png", "2.png"]


def test_photos_beside_the_folder_of_images_are_told(tmp_path: Path) -> None:
    fill(tmp_path / "images")
    fill(tmp_path / "images_4")
    fill(tmp_path / "second", first=5)
    photos = looked_at(tmp_path)
    assert photos.folder == tmp_path / "images"
    assert photos.notes[1:] == [
        "not used: photos in second (3). Put all photos of one scene into one folder to use them"
    ]


@pytest.mark.parametrize(
    "file",
    ["cameras.xml", "model.nvm", "sfm_data.json", "poses.txt", "cameras.json", "a.MOV", ".b.jpg.icloud"],
)
def test_what_lies_beside_photos_and_is_not_read_is_told(file: str, tmp_path: Path) -> None:
    fill(tmp_path)
    assert len(looked_at(tmp_path).notes) == 1
    (tmp_path / file).write_text("something")
    _, note = looked_at(tmp_path).notes
    assert note.startswith(f"{file}: not ")


@pytest.mark.parametrize("suffix", [".jfif", ".jpe", ".avif", ".jp2"])
def test_photos_of_rarer_suffixes(suffix: str, tmp_path: Path) -> None:
    if suffix == ".avif" and not features.check("avif"):
        pytest.skip("this Pillow reads no AVIF")
    fill(tmp_path, suffix=suffix)
    photos = looked_at(tmp_path)
    assert len(photos.names) == 3
    photos.write(tmp_path / "for_colmap")
    for path in (tmp_path / "for_colmap").iterdir():
        with Image.open(path) as photo:
            assert (photo.format, photo.size) == ("JPEG", (64, 48))


def test_two_hundred_megapixels_are_read_and_more_than_memory_are_not(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    Image.new("L", (16320, 12240), 7).save(tmp_path / "a.jpg")
    assert decode(tmp_path / "a.jpg", (500, 500))[0].shape == (1530, 2040, 3)
    assert not len(recwarn)
    Image.new("1", (1 << 15, LARGEST // (1 << 15) + 1)).save(tmp_path / "b.png")
    with pytest.raises(UnreadableError, match=r"32768 x 8193 px are more than 268 megapixels"):
        glance(tmp_path / "b.png")


def test_photos_that_are_in_a_cloud_alone_are_told(tmp_path: Path) -> None:
    fill(tmp_path, 4)
    (tmp_path / "0.png").write_bytes(b"")
    (tmp_path / ".IMG_5.JPG.icloud").write_bytes(b"a name")
    (tmp_path / "b.jpg.crdownload").write_bytes(b"half")
    photos = looked_at(tmp_path)
    assert photos.unreadable == {"0.png": "0 bytes: its download or copy was not finished"}
    told = ".IMG_5.JPG.icloud, b.jpg.crdownload: not fully downloaded: download it first"
    assert photos.notes == ["3 photos, no camera in EXIF", told]


def test_a_film_alone_in_a_folder_is_that_film(tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    (folder / "DCIM").mkdir(parents=True)
    film = folder / "DCIM" / "IMG_1.MOV"
    film.write_bytes(b"a film")
    (folder / ".DS_Store").write_bytes(b"")
    assert film_at(folder) == film_at(film) == film
    check_film(folder)
    (folder / "other.mp4").write_bytes(b"another")
    assert film_at(folder) is None
    (folder / "other.mp4").unlink()
    fill(folder)
    assert film_at(folder) is None


def test_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    fill(tmp_path / "walk")
    assert existing_folder("~/walk") == tmp_path / "walk"


# --- Photos and masks that are not what they seem: suffixes, lossy masks, orientations, pictures of runs


RED = Image.fromarray(np.full((64, 96, 3), (200, 60, 90), np.uint8))


def test_a_jpeg_called_heic_is_a_jpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the extra too, which it does not need."""
    for k in range(3):
        RED.resize((96, 64 + 8 * k)).save(tmp_path / f"{k}.HEIC", "jpeg")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    assert looked_at(tmp_path).names == ["0.HEIC", "1.HEIC", "2.HEIC"]
    assert np.abs(decode(tmp_path / "0.HEIC")[0].mean((0, 1)) - (200, 60, 90)).max() < 4


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".JPEG"])
def test_a_heic_of_another_suffix_is_read_in_a_new_process(tmp_path: Path, suffix: str) -> None:
    """Where nothing has opened a .heic before."""
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    path = tmp_path / f"a{suffix}"
    RED.save(path, "heif")
    code = f"from hqgs.photos.files import *; print(glance(Path({str(path)!r})).size)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "(96, 64)"
    assert glance(path).format == "HEIF"


def test_colmap_is_given_what_it_reads(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    RED.save(tmp_path / "a.jpg", "heif")
    RED.save(tmp_path / "b.jpg", "webp")
    RED.save(tmp_path / "c.jpg", "png")
    RED.save(tmp_path / "d.HEIC", "jpeg")
    photos = looked_at(tmp_path)
    names = ["a.jpg", "b.jpg", "c.jpg", "d.HEIC.jpg"]
    assert list(photos.colmap_names) == names
    (tmp_path / "out").mkdir()
    photos.write(tmp_path / "out")
    assert [glance(tmp_path / "out" / name).format for name in names] == ["JPEG", "JPEG", "PNG", "JPEG"]


def disc(width: int = 96, height: int = 72) -> Image.Image:
    picture = Image.new("L", (width, height))
    ImageDraw.Draw(picture).ellipse((30, 20, 60, 50), fill=255)
    return picture


@pytest.mark.parametrize(
    ("suffix", "options"),
    [(".jpg", {"quality": 40}), (".png", {}), (".webp", {"quality": 40}), (".webp", {"lossless": True})],
)
def test_masks_show_their_true_share(tmp_path: Path, suffix: str, options: dict[str, Any]) -> None:
    """A lossy file blurs the edge into its blocks: half of white counts there."""
    true = np.asarray(disc()) > 0
    path = tmp_path / f"mask{suffix}"
    disc().convert("RGB" if suffix == ".webp" else "L").save(path, **options)
    read = decode_mask(path, 96, 72)
    lossless = suffix == ".png" or "lossless" in options
    assert (read != true).mean() <= (0 if lossless else 0.01)


def test_a_jpeg_mask_is_known_by_its_content(tmp_path: Path) -> None:
    disc().save(tmp_path / "mask.png", "jpeg", quality=40)
    assert (decode_mask(tmp_path / "mask.png", 96, 72) != (np.asarray(disc()) > 0)).mean() < 0.01


def test_masks_of_zero_and_one_labels_and_alpha(tmp_path: Path) -> None:
    true = np.asarray(disc()) > 0
    for name, values in (("ones", true.astype(np.uint8)), ("labels", true * np.uint8(3))):
        Image.fromarray(values).save(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(decode_mask(tmp_path / f"{name}.png", 96, 72), true)
    rgba = np.dstack([np.full((72, 96, 3), 255, np.uint8), true * np.uint8(255)])
    Image.fromarray(rgba).save(tmp_path / "alpha.png")
    np.testing.assert_array_equal(decode_mask(tmp_path / "alpha.png", 96, 72), true)


@pytest.mark.parametrize(("orientation", "turn"), [(0, 0), (1, 0), (6, 1), (8, 3), (9, 0), (255, 0)])
def test_orientations_that_there_are_none_of(tmp_path: Path, orientation: int, turn: int) -> None:
    RED.save(tmp_path / "a.jpg", exif=exif(orientation))
    assert read_exif(tmp_path / "a.jpg").quarter_turns == turn
    assert glance(tmp_path / "a.jpg").size == (96, 64)


def test_the_pictures_of_a_run_are_no_photos(tmp_path: Path) -> None:
    """Of a finished one, of one that has just begun, and of what COLMAP keeps in it."""
    for k in range(3):
        (tmp_path / "photos").mkdir(exist_ok=True)
        RED.resize((96, 64 + 8 * k)).save(tmp_path / f"photos/{k}.jpg")
    for run, files in {"run": ("config.json", "scene.ply"), "begun": (".lock",)}.items():
        (tmp_path / run / "comparison").mkdir(parents=True)
        for name in files:
            (tmp_path / run / name).write_text("{}")
        RED.save(tmp_path / run / "comparison/a.png")
    assert looked_at(tmp_path).names == ["0.jpg", "1.jpg", "2.jpg"]
    with pytest.raises(ValueError, match="run that hqgs wrote"):
        load_scene(tmp_path / "run")


def test_colmap_bears_orientations_that_there_are_none_of(tmp_path: Path) -> None:
    """In a process of its own: some versions abort."""
    for k, orientation in enumerate((0, 9, 6)):
        RED.save(tmp_path / f"{k}.jpg", exif=exif(orientation))
    code = (
        "import pycolmap; from pathlib import Path; root = Path(" + repr(str(tmp_path)) + ");"
        "pycolmap.extract_features(root / 'a.db', root);"
        "print(sum(1 for _ in pycolmap.Database.open(root / 'a.db').read_all_images()))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split()[-1] == "3"


def test_alpha_of_some_photos_stays_a_mask(tmp_path: Path) -> None:
    """A set is of cut-out objects where all its photos can be transparent, and none has a mask."""
    truth = make_truth(4)
    write_colmap(truth, tmp_path)
    alpha = np.full((36, 48), 255, np.uint8)
    alpha[:, :24] = 0
    rgba = np.dstack([truth.photos[1], alpha])
    Image.fromarray(rgba).save(tmp_path / "images/view_01.png")
    view = load_scene(tmp_path, test_every=0).train[1]
    assert view.mask is not None
    assert view.mask.mean() == 0.5
    for k in (0, 2, 3):
        Image.fromarray(np.dstack([truth.photos[k], alpha])).save(tmp_path / f"images/view_{k:02d}.png")
    scene = load_scene(tmp_path, test_every=0)
    assert all(view.mask is None and not view.image[:, :24].any() for view in scene.train)
    np.testing.assert_array_equal(scene.train[2].image[:, 24:], truth.photos[2][:, 24:])
