"""Folders of photos as people have them: what is a photo, and what of a folder is not read."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from fixtures_photos import looked_at, picture
from PIL import Image, features

from hqgs.photos.files import LARGEST, UnreadableError, decode, glance
from hqgs.scene.film import check_film
from hqgs.scene.names import existing_folder
from hqgs.scene.photo_files import film_at


def pictures(folder: Path, count: int = 3, first: int = 0, suffix: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(first, first + count):
        picture(k, (64, 48)).save(folder / f"{k}{suffix}")


@pytest.mark.parametrize("inner", ["DCIM/100APPLE", "Takeout/Google Photos/Walk", "a/b/c/d/e"])
def test_photos_far_down_are_found_and_the_folder_is_named(inner: str, tmp_path: Path) -> None:
    pictures(tmp_path / inner)
    (tmp_path / "__MACOSX" / inner).mkdir(parents=True)
    (tmp_path / "__MACOSX" / inner / "._0.png").write_bytes(b"no picture")
    photos = looked_at(tmp_path)
    assert (photos.folder, photos.names) == (tmp_path / inner, ["0.png", "1.png", "2.png"])
    assert f"the photos are those in {inner}, below {tmp_path.name}" in photos.notes


def test_maps_beside_photos_are_no_photos(tmp_path: Path) -> None:
    pictures(tmp_path / "rgb")
    for k, name in enumerate(("depth", "Confidence", "normal_maps", "thumbs")):
        pictures(tmp_path / name, first=10 * k)
    photos = looked_at(tmp_path)
    assert photos.folder == tmp_path / "rgb"
    told = "their names say that they hold no photos: Confidence, depth, normal_maps, thumbs"
    assert any(note.endswith(told) for note in photos.notes)
    shutil.rmtree(tmp_path / "rgb")  # what else is there is all that can be meant
    assert len(looked_at(tmp_path).names) == 12


def test_an_empty_folder_of_images_hides_no_photos(tmp_path: Path) -> None:
    pictures(tmp_path)
    (tmp_path / "images").mkdir()
    assert looked_at(tmp_path).names == ["0.png", "1.png", "2.png"]


def test_photos_beside_the_folder_of_images_are_told(tmp_path: Path) -> None:
    pictures(tmp_path / "images")
    pictures(tmp_path / "images_4")
    pictures(tmp_path / "second", first=5)
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
    pictures(tmp_path)
    assert len(looked_at(tmp_path).notes) == 1
    (tmp_path / file).write_text("something")
    _, note = looked_at(tmp_path).notes
    assert note.startswith(f"{file}: not ")


@pytest.mark.parametrize("suffix", [".jfif", ".jpe", ".avif", ".jp2"])
def test_photos_of_rarer_suffixes(suffix: str, tmp_path: Path) -> None:
    if suffix == ".avif" and not features.check("avif"):
        pytest.skip("this Pillow reads no AVIF")
    pictures(tmp_path, suffix=suffix)
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
    pictures(tmp_path, 4)
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
    pictures(folder)
    assert film_at(folder) is None


def test_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    pictures(tmp_path / "walk")
    assert existing_folder("~/walk") == tmp_path / "walk"
