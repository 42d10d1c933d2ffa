"""Folders as other machines and programs leave them: names, layouts, splits, photos that are gone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unicodedata import normalize

import numpy as np
import pytest
from fixtures_scenes import Truth, frames, make_truth, write_colmap, write_photos, write_transforms
from PIL import Image

from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene


def same_views(scene: Scene, truth: Truth) -> None:
    """Every photo of the truth has its own camera."""
    views = {view.image.tobytes(): view for view in scene.train + scene.test}
    assert len(views) == len(truth.names)
    for photo, viewmat in zip(truth.photos, truth.viewmats, strict=True):
        np.testing.assert_allclose(views[photo.tobytes()].camera.viewmat, viewmat, atol=1e-9)


SPACES = ["A DJI 0 (40).png", "A DJI 1 (7).png", "  b  c.png".strip(), "Ä ö 1.png"]
THREE = [f"{k} of 4.png" for k in range(4)]  # as many words as a point has numbers


@pytest.mark.parametrize("names", [SPACES, THREE])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_names_with_spaces_in_text_models(tmp_path: Path, end: str, names: list[str]) -> None:
    truth = replace(make_truth(4), names=names)
    write_colmap(truth, tmp_path, binary=False)
    path = tmp_path / "sparse/0/images.txt"
    text = "# Image list\n\n" + path.read_text(encoding="utf-8").replace("1.5 2.5 -1", "")
    for last in ("", "\n", "\n\n"):  # editors take away the last photo's empty line of points
        path.write_bytes((text.rstrip() + last).replace("\n", end).encode())
        scene = load_scene(tmp_path, test_every=0)
        assert [view.name for view in scene.train] == sorted(names)
        same_views(scene, truth)


def written(prefix: str, separator: str = "/") -> Callable[[str], str]:
    return lambda name: f"{prefix}{separator}{name}"


FORMS: dict[str, Callable[[str], str]] = {
    "backslashes": written("images", "\\"),
    "of a drive": written("C:\\Users\\Me\\scene\\images", "\\"),
    "of another home": written("/home/other/scene/images"),
    "beside": written("../slike", "\\"),
    "a folder before it": written("scene/images"),
    "no folder": lambda name: name,
    "another case": lambda name: f"Images/{name.upper()}",
    "another suffix": lambda name: f"images/{name.removesuffix('.png')}.JPG",
    "an escaped space": lambda name: f"images/{name.replace(' ', '%20')}",
    "a URL": lambda name: f"file:///data/images/{name}",
    "decomposed": lambda name: normalize("NFD", f"images/{name}"),
}
NAMES = ["Ä view 0.png", "view 1.png", "view_2.png", "b.c.png"]


@pytest.mark.parametrize("form", FORMS)
def test_photos_of_transforms_are_found_as_other_machines_name_them(tmp_path: Path, form: str) -> None:
    truth = replace(make_truth(4), names=NAMES)
    entries = frames(truth)
    for entry, name in zip(entries, NAMES, strict=True):
        entry["file_path"] = FORMS[form](name)
    same_views(load_scene(write_transforms(truth, tmp_path, frames=entries), test_every=0), truth)


@pytest.mark.parametrize("form", FORMS)
def test_photos_of_a_model_are_found_as_other_machines_name_them(tmp_path: Path, form: str) -> None:
    truth = replace(make_truth(4), names=[FORMS[form](name) for name in NAMES])
    write_colmap(truth, tmp_path, binary=False, images=None)
    write_photos(truth, tmp_path / "images", NAMES)
    same_views(load_scene(tmp_path, test_every=0), truth)


def test_what_was_found_by_name_is_said_and_what_is_ambiguous_is_not_guessed(tmp_path: Path) -> None:
    truth = make_truth(4)
    entries = frames(truth)
    for entry in entries:
        entry["file_path"] = "D:\\x\\" + entry["file_path"].removeprefix("images/")
    write_transforms(truth, tmp_path, frames=entries)
    (note,) = [note for note in load_scene(tmp_path).notes if "by name" in note]
    assert "4 photos" in note
    assert "images/view_00.png for D:\\x\\view_00.png" in note
    # The same name in two folders, none of which is `images` or written: left out, and named.
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
    (tmp_path / "left/view_01.png").write_bytes((tmp_path / "images/view_01.png").read_bytes())
    (tmp_path / "images/view_01.png").rename(tmp_path / "right/view_01.png")
    scene = load_scene(tmp_path, test_every=0)
    assert len(scene.train) == 3
    assert "1 of 4 cameras have no photo" in "".join(scene.notes)
    # What is written of the folders decides.
    entries[1]["file_path"] = "D:\\x\\Right\\view_01.png"
    write_transforms(truth, tmp_path, frames=entries)
    (tmp_path / "images/view_01.png").unlink()
    same_views(load_scene(tmp_path, test_every=0), truth)


LAYOUTS = {  # where the model lies, and where the photos
    "photos beside the model": ("sparse/0", "sparse/0"),
    "all in one folder": (".", "."),
    "photos in the folder": ("sparse/0", "."),
    "colmap": ("colmap/sparse/0", "images"),
    "colmap, with its photos": ("colmap/sparse/0", "colmap/images"),
    "distorted": ("distorted/sparse/0", "input"),
    "input": ("sparse", "input"),
    "another name": ("sparse/0", "rgb"),
    "a folder around it": ("scene/sparse/0", "scene/images"),
    "deep": ("a/b/sparse/0", "a/b/images"),
    "scaled photos alone": ("sparse/0", "images_2"),
    "capitals": ("Sparse/0", "Images"),
    "a number in a folder of models": ("colmap_output/0", "frames"),
    "one folder more": ("sparse/final/0", "images"),
    "sfm": ("sfm/sparse/0", "images"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("binary", [True, False])
def test_layouts(tmp_path: Path, layout: str, binary: bool) -> None:
    model, photos = LAYOUTS[layout]
    truth = make_truth(4)
    write_colmap(truth, tmp_path, model=model, images=photos, binary=binary)
    scene = load_scene(tmp_path, test_every=0)
    assert scene.source == "colmap"
    same_views(scene, truth)


def test_a_scene_one_folder_further_down(tmp_path: Path) -> None:
    truth = make_truth(4)
    write_transforms(truth, tmp_path / "outer/inner")
    scene = load_scene(tmp_path / "outer", test_every=0)
    assert scene.source == "transforms"
    assert scene.notes[0] == "the scene is the one in inner"
    write_transforms(truth, tmp_path / "outer/other")
    with pytest.raises(ValueError, match="several scenes: give one of inner, other"):
        load_scene(tmp_path / "outer")


def test_a_model_further_down_gives_way_to_transforms(tmp_path: Path) -> None:
    """As ns-process-data leaves both."""
    truth = make_truth(4)
    write_colmap(truth, tmp_path, model="colmap/sparse/0", images=None)
    assert load_scene(write_transforms(truth, tmp_path)).source == "transforms"


def split_of(scene: Scene) -> tuple[list[int], list[int]]:
    def number(name: str) -> int:
        return int(name.rsplit("_", 1)[1].removesuffix(".png"))

    return [number(v.name) for v in scene.train], [number(v.name) for v in scene.test]


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train": [0, 1, 4], "test": [2, 3], "val": [5]}, [0, 1, 4], [2, 3]),
        ({"train": [0, 1, 4], "val": [5]}, [0, 1, 4], [5]),
        ({"train": [0, 1, 4]}, [0, 1, 4], [2, 3, 5]),
        ({"test": [5]}, [0, 1, 2, 3, 4], [5]),
        ({"val": [1], "test": [2, 5]}, [0, 3, 4], [2, 5]),
    ],
)
@pytest.mark.parametrize("slash", ["/", "\\"])
def test_a_file_that_names_its_own_split(
    tmp_path: Path, lists: dict[str, list[int]], train: list[int], test: list[int], slash: str
) -> None:
    truth = make_truth(6)
    entries = frames(truth)
    for entry in entries:
        entry["file_path"] = entry["file_path"].replace("/", slash)
    values = {f"{key}_filenames": [entries[k]["file_path"] for k in v] for key, v in lists.items()}
    scene = load_scene(write_transforms(truth, tmp_path, frames=entries, **values))
    assert split_of(scene) == (train, test)
    assert "transforms.json" in next(note for note in scene.notes if "split" in note)
    if rest := sorted(set(range(6)) - {*train, *test}):
        assert any(f"{len(rest)} photos are in no list" in note for note in scene.notes)


def test_a_split_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    names = [f"images/{name}" for name in make_truth(6).names]
    write_transforms(make_truth(6), tmp_path, train_filenames=names, test_filenames=names[:1])
    with pytest.raises(ValueError, match=r"training and held out: images/view_00\.png"):
        load_scene(tmp_path)
    write_transforms(make_truth(6), tmp_path, train_filenames=3)
    with pytest.raises(ValueError, match="train_filenames must be a list of names"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("files", "train", "test"),
    [
        ({"train": [0, 1], "val": [2]}, [0, 1], [2]),
        ({"train": [0, 1], "val": [2], "test": [3, 4]}, [0, 1], [3, 4]),
        ({"": [0, 1, 3, 4], "test": [3, 4]}, [0, 1], [3, 4]),
        ({"": [0, 1, 2, 3, 4], "train": [0, 1, 2], "test": [3, 4]}, [0, 1, 2], [3, 4]),
    ],
)
def test_transforms_files_of_a_split(
    tmp_path: Path, files: dict[str, list[int]], train: list[int], test: list[int]
) -> None:
    truth = make_truth(6)
    write_transforms(truth, tmp_path)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").unlink()
    for kind, rows in files.items():
        name = f"transforms_{kind}.json" if kind else "transforms.json"
        content = meta | {"frames": [meta["frames"][k] for k in rows]}
        (tmp_path / name).write_text(json.dumps(content))
    scene = load_scene(tmp_path)
    assert split_of(scene) == (train, test)
    kind = "test" if "test" in files else "val"
    assert f"transforms_{kind}.json; test_every is not used" in "".join(scene.notes)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("sparse/0/test.txt", "view_02\nview_04.png\n"),
        ("test.txt", "\ufeffimages\\view_02.png\r\nimages\\view_04.png\r\n"),
        ("train_test_lists.json", '{"train": ["view_00.png", "view_01.png", "view_03.png", "view_05.png"]}'),
        ("split.json", '{"test": ["images/view_02.png", "view_04.png"]}'),
    ],
)
def test_a_split_beside_a_model(tmp_path: Path, file: str, content: str) -> None:
    write_colmap(make_truth(6), tmp_path)
    (tmp_path / file).write_text(content, encoding="utf-8")
    scene = load_scene(tmp_path)
    assert split_of(scene) == ([0, 1, 3, 5], [2, 4])
    assert not any("match no photo" in note for note in scene.notes)
    assert file in next(note for note in scene.notes if "split" in note)


def test_names_in_a_text_model_are_text(tmp_path: Path) -> None:
    truth = make_truth(4)
    spaced = replace(truth, names=[name.replace("_", "\u202f") for name in truth.names])
    scene = load_scene(write_colmap(spaced, tmp_path / "spaced", binary=False), test_every=0)
    assert [view.name for view in scene.train] == sorted(spaced.names)
    root = write_colmap(truth, tmp_path / "latin", binary=False)
    file = next(root.rglob("images.txt"))
    file.write_bytes(file.read_bytes().replace(b"view_01", b"view_\xe9"))
    (root / "images/view_01.png").rename(root / "images/view_\u00e9.png")
    assert len(load_scene(root, test_every=0).train) == 4  # as Windows writes it
    file.write_bytes(file.read_bytes().replace(b"view_\xe9", b"view_\x81"))
    notes = load_scene(root, test_every=0).notes
    assert "1 of 4 cameras have no photo any more and were left out: view_%81.png" in notes


def maps(root: Path, truth: Truth) -> None:
    """A grey picture for each photo, under its name."""
    root.mkdir(parents=True)
    for name in truth.names:
        Image.fromarray(np.full((36, 48), 5000, np.uint16)).save(root / name)


@pytest.mark.parametrize("folder", ["depth", "Normal_maps", "mask", "Masks"])
def test_maps_are_not_taken_for_the_photos_of_a_model(tmp_path: Path, folder: str) -> None:
    truth = make_truth(5)
    write_colmap(truth, tmp_path, images="rgb")
    maps(tmp_path / folder, truth)
    scene = load_scene(tmp_path, test_every=0)
    for view, photo in zip(scene.train, truth.photos, strict=True):
        np.testing.assert_array_equal(view.image, photo)
    (tmp_path / "rgb/view_03.png").unlink()  # then more maps than photos have the names
    left = load_scene(tmp_path, test_every=0).train
    assert [view.name for view in left] == ["view_00.png", "view_01.png", "view_02.png", "view_04.png"]
    np.testing.assert_array_equal(left[3].image, truth.photos[4])


def test_photos_in_a_folder_called_after_maps_are_found_where_there_are_no_others(tmp_path: Path) -> None:
    truth = make_truth(4)
    (tmp_path / "images").mkdir()
    same_views(load_scene(write_colmap(truth, tmp_path, images="thumbnails"), test_every=0), truth)
    entries = frames(truth, "D:/scene/thumbnails")
    write_transforms(truth, tmp_path / "b", frames=entries)
    (tmp_path / "b/images").rename(tmp_path / "b/thumbnails")
    same_views(load_scene(tmp_path / "b", test_every=0), truth)


@pytest.mark.parametrize("folder", ["depths", "normals", "mask", "masks"])
def test_a_photo_that_is_gone_is_not_its_map(tmp_path: Path, folder: str) -> None:
    truth = make_truth(5)
    write_transforms(truth, tmp_path)
    maps(tmp_path / folder, truth)
    (tmp_path / "images/view_03.png").unlink()
    scene = load_scene(tmp_path, test_every=0)
    assert [view.name[7:] for view in scene.train] == [name for name in truth.names if "03" not in name]


@pytest.mark.parametrize("files", ["one", "split", "and one that is not read"])
def test_a_photo_that_is_gone_is_not_that_of_another_frame(tmp_path: Path, files: str) -> None:
    """Two cameras of a rig, and the parts of a Blender set, give their photos the same names."""
    truth = make_truth(8)
    names = [f"view_{k:02d}.png" for k in range(4)]
    halves = [replace(truth, names=names, photos=truth.photos[k::2]) for k in range(2)]
    entries = []
    for k, (folder, half) in enumerate(zip(("train", "test"), halves, strict=True)):
        write_photos(half, tmp_path / folder)
        entries += frames(replace(half, viewmats=truth.viewmats[k::2]), folder)
    meta = {"fl_x": 40.0, "w": 48, "h": 36}
    (tmp_path / "train/view_02.png").unlink()
    if files == "one":
        (tmp_path / "transforms.json").write_text(json.dumps(meta | {"frames": entries}))
    else:
        for name, part in (("train", entries[:4]), ("test", entries[4:])):
            (tmp_path / f"transforms_{name}.json").write_text(json.dumps(meta | {"frames": part}))
        if files != "split":
            write_photos(halves[1], tmp_path / "val")
            part = [entry | {"file_path": entry["file_path"].replace("test", "val")} for entry in entries[4:]]
            (tmp_path / "transforms_val.json").write_text(json.dumps(meta | {"frames": part}))
    scene = load_scene(tmp_path, test_every=0)
    assert sorted(v.name for v in scene.train if "train" in v.name) == [
        f"train/view_{k:02d}.png" for k in (0, 1, 3)
    ]
    assert len(scene.train + scene.test) == 7
    assert any("no photo any more and were left out: train/view_02.png" in note for note in scene.notes)


def test_a_photo_that_is_gone_with_its_mask_is_left_out(tmp_path: Path) -> None:
    truth = make_truth(5)
    entries = frames(truth)
    for entry, name in zip(entries, truth.names, strict=True):
        entry["mask_path"] = f"masks/{name}"
    write_transforms(truth, tmp_path, frames=entries)
    (tmp_path / "masks").mkdir()
    for name in truth.names:
        Image.new("L", (48, 36), 255).save(tmp_path / "masks" / name)
    (tmp_path / "masks/view_03.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"view_03.*mask_path 'masks/view_03\.png' is not a file"):
        load_scene(tmp_path)
    (tmp_path / "images/view_03.png").unlink()
    assert len(load_scene(tmp_path, test_every=0).train) == 4


@pytest.mark.parametrize("content", ["my notes\n", ""])
def test_a_text_that_names_no_photo_is_no_split(tmp_path: Path, content: str) -> None:
    write_colmap(make_truth(6), tmp_path)
    own = load_scene(tmp_path)
    (tmp_path / "test.txt").write_text(content)
    scene = load_scene(tmp_path)
    assert split_of(scene) == split_of(own)
    assert "test.txt names none of the photos, and is not used as a split" in scene.notes
