"""Folders of photos with what people keep beside them: copies, films, cameras of other programs, GPS."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from fixtures_cards import HEIGHT, WIDTH
from fixtures_photos import exif, looked_at, picture
from fixtures_scenes import make_truth, write_transforms
from PIL import Image

from hqgs.base.stages import Stage
from hqgs.photos.exif import read_exif
from hqgs.scene.load import load_scene
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
        "5 photos, 3 of them by 1 cameras in EXIF, 2 duplicates not used",
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
    second.save(tmp_path / "IMG_0002.jpg")
    third.save(tmp_path / "IMG_0002 (1).jpg")
    assert looked_at(tmp_path).names == ["IMG_0001.jpg", "IMG_0002 (1).jpg", "IMG_0002.jpg"]


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
    (tmp_path / "frames.json").write_text("{}")
    assert looked_at(tmp_path).names == ["0.png", "1.png", "2.png"]


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
