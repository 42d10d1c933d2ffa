"""Captures as strangers bring them: one bad part refuses nothing, whatever the names, disks and sizes."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_photos import looked_at
from fixtures_scenes import Truth, make_truth, write_colmap, write_llff, write_photos, write_transforms
from PIL import Image
from test_film import encoded
from test_georeference import EAST, METRES, NORTH
from test_synthetic import depth_error, views_of

from hqgs.base.files import atomic_path, keep_folder, lock_folder, write_json, write_text
from hqgs.photos.exif import Exif, read_exif
from hqgs.photos.files import UnreadableError, decode_mask, glance
from hqgs.photos.pixels import grey
from hqgs.scene import place
from hqgs.scene.capture import Capture, Photo
from hqgs.scene.film import film_frames, write_details
from hqgs.scene.georeference import georeference
from hqgs.scene.load import load_scene
from hqgs.scene.named_split import listed_split, names_by_any
from hqgs.scene.photo_files import below
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.likely import likely_pairs
from hqgs.scene.sfm.triangulated import SparsePoints, triangulated

LATIN = "caf\udce9 1.png"  # é in the code of an older Windows, as Python reads it from the disk


def check(scene: Scene, truth: Truth) -> None:
    """Every photo is there, with its pixels, under a name that can be written."""
    assert len(scene.train) == len(truth.photos)
    for view, photo in zip(scene.train, truth.photos, strict=True):
        np.testing.assert_array_equal(view.image, photo)
        view.name.encode()
    "; ".join(scene.notes).encode()


def renamed_in_model(path: Path, old: bytes, new: bytes) -> None:
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))


@pytest.mark.parametrize("model", ["bin", "txt"])
@pytest.mark.parametrize("on_disk", [LATIN, "café 1.png"])
@pytest.mark.parametrize("in_model", [b"caf\xe9 1.png", b"caf\xc3\xa9 1.png"])
def test_names_of_other_codes_in_models_and_on_disk(
    tmp_path: Path, model: str, on_disk: str, in_model: bytes
) -> None:
    truth = make_truth(4)
    write_colmap(truth, tmp_path, binary=model == "bin")
    os.rename(tmp_path / "images" / truth.names[0], tmp_path / "images" / on_disk)
    renamed_in_model(tmp_path / "sparse" / "0" / f"images.{model}", truth.names[0].encode(), in_model)
    check(load_scene(tmp_path, test_every=0), truth)


@pytest.mark.parametrize("write", [write_colmap, write_transforms, write_llff])
def test_a_scene_in_a_folder_of_another_code(tmp_path: Path, write: Callable[[Truth, Path], Path]) -> None:
    truth = make_truth(4)
    check(load_scene(write(truth, tmp_path / "Jos\udce9" / "\udcff"), test_every=0), truth)


def test_photos_alone_of_another_code_are_used(tmp_path: Path) -> None:
    truth = make_truth(5)
    write_photos(truth, tmp_path)
    os.rename(tmp_path / truth.names[0], tmp_path / LATIN)
    photos = looked_at(tmp_path)
    assert LATIN in photos.names
    assert not photos.unreadable
    for name in photos.colmap_names:
        name.encode()
    photos.write(tmp_path / "copies")
    assert sorted(os.listdir(tmp_path / "copies")) == sorted(photos.colmap_names)


def test_what_is_written_can_be_read(tmp_path: Path) -> None:
    write_text(tmp_path / "a.html", f"photo {LATIN}")
    assert (tmp_path / "a.html").read_bytes() == b"photo caf%E9 1.png"
    folder = tmp_path / "Jos\udce9"
    write_json(folder / "a.json", {"path": str(folder)})
    assert json.loads((folder / "a.json").read_bytes()) == {"path": str(folder)}  # the path still leads there


@pytest.mark.parametrize("write", [write_colmap, write_transforms, write_llff])
@pytest.mark.parametrize("link", ["images", "images/cam0", "photo"])
def test_links_are_followed(tmp_path: Path, write: Callable[[Truth, Path], Path], link: str) -> None:
    truth = make_truth(4)
    if link == "images/cam0":
        truth = Truth([f"cam0/{name}" for name in truth.names], *list(vars(truth).values())[1:])
    write(truth, tmp_path / "scene")
    target = truth.names[0] if link == "photo" else ""
    path = tmp_path / "scene" / ("images" if link == "photo" else link) / target
    shutil.move(path, tmp_path / f"elsewhere{path.suffix}")
    path.symlink_to(tmp_path / f"elsewhere{path.suffix}")
    check(load_scene(tmp_path / "scene", test_every=0), truth)


def test_links_count_once_and_loops_end(tmp_path: Path) -> None:
    for name in ("a/1.png", "b/2.png"):
        (tmp_path / "scene" / name).parent.mkdir(parents=True)
        Image.new("L", (8, 8)).save(tmp_path / "scene" / name)
    (tmp_path / "scene" / "a" / "up").symlink_to(tmp_path / "scene")
    (tmp_path / "scene" / "0").symlink_to(tmp_path / "scene" / "b")  # the folder itself counts, not its link
    (tmp_path / "scene" / "all").symlink_to(tmp_path)
    (tmp_path / "scene" / "gone").symlink_to(tmp_path / "nowhere")
    (tmp_path / "other").mkdir()
    Image.new("L", (8, 8)).save(tmp_path / "other" / "3.png")
    (tmp_path / "other" / "back").symlink_to(tmp_path / "other")
    for name in ("x", "y"):
        (tmp_path / "scene" / name).symlink_to(tmp_path / "other")
    found = [p.relative_to(tmp_path / "scene").as_posix() for p in below(tmp_path / "scene", (".png",))]
    assert found == ["a/1.png", "b/2.png", "x/3.png"]


def test_photos_alone_behind_links_count_once(tmp_path: Path) -> None:
    truth, root = make_truth(5), tmp_path / "scene"
    write_photos(truth, tmp_path / "card" / "walk")
    root.mkdir()
    (root / "a").symlink_to(tmp_path / "card" / "walk")
    (root / "b").symlink_to(tmp_path / "card" / "walk")
    (tmp_path / "card" / "walk" / "back").symlink_to(root)
    found = looked_at(root)
    assert found.names == truth.names
    assert not any("copies" in note or "not used" in note for note in found.notes)


@pytest.mark.parametrize("root", ["/home/u/scene/images/", "C:\\scans\\images\\", "file:///srv/x/images/"])
def test_absolute_paths_of_another_machine(tmp_path: Path, root: str) -> None:
    """In a model whose folder of photos is a link."""
    truth = make_truth(4)
    write_colmap(truth, tmp_path / "scene", images=None)
    write_photos(truth, tmp_path / "photos")
    (tmp_path / "scene" / "images").symlink_to(tmp_path / "photos")
    model = tmp_path / "scene" / "sparse" / "0" / "images.bin"
    for name in truth.names:
        renamed_in_model(model, name.encode(), (root + name).encode())
    check(load_scene(tmp_path / "scene", test_every=0), truth)


@pytest.mark.parametrize("code", ["ENOLCK", "ENOTSUP", "EOPNOTSUPP", "ENOSYS", "EINVAL"])
def test_a_file_system_without_locks(
    tmp_path: Path, code: str, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    def lacks(*_: Any) -> None:
        raise OSError(getattr(errno, code), os.strerror(getattr(errno, code)))

    monkeypatch.setattr(fcntl, "flock", lacks)
    with lock_folder(tmp_path / "run"):
        write_text(tmp_path / "run" / "a.txt", "a")
    assert (tmp_path / "run" / "a.txt").read_text() == "a"
    assert code == "ENOSYS" or "has no file locks" in caplog.text


@pytest.mark.parametrize("call", ["fsync", "chmod"])
@pytest.mark.parametrize("code", ["EPERM", "EINVAL", "ENOTSUP", "ENOSYS"])
def test_a_file_system_without_flushes_or_permissions(
    tmp_path: Path, call: str, code: str, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    def lacks(*_: Any, **__: Any) -> None:
        raise OSError(getattr(errno, code), os.strerror(getattr(errno, code)))

    monkeypatch.setattr(os, call, lacks)
    write_text(tmp_path / "run" / "a.txt", "a")
    if call == "fsync":
        keep_folder(tmp_path / "run", tmp_path / "kept")
    assert (tmp_path / "run" / "a.txt").read_text() == "a"
    assert "the file system has no" in caplog.text


def test_what_says_that_a_disk_is_full_or_broken_is_still_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.EIO, "input/output error")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="input/output"), atomic_path(tmp_path / "a") as tmp:
        tmp.write_text("a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("encoding", ["ascii", "utf-8:strict", "cp1252"])
def test_a_console_that_cannot_show_a_path(tmp_path: Path, encoding: str) -> None:
    folder = tmp_path / "Jos\udce9 \u1234"
    folder.mkdir()
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    command = [sys.executable, "-m", "hqgs", "info", folder]
    told = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert told.returncode == 2
    assert b"is empty: give a folder with photos" in told.stderr


# --- Captures as strangers bring them: names with blanks and numbers, 16 bits, faces, films without a length


def test_names_with_blanks_find_their_pairs(cards: Scene, tmp_path: Path) -> None:
    """As frames of a film, whose pairs are listed; the photos keep their names."""
    names = []
    for k, view in enumerate(sorted([*cards.train, *cards.test], key=lambda view: view.name)):
        names.append(f"My walk ({k}).png" if k else "#1.png")
        Image.fromarray(view.image.astype(np.uint8)).save(tmp_path / names[-1])
    photos = looked_at(tmp_path)
    assert sorted(photos.colmap_names) == sorted(name.replace(" ", "_").replace("#", "_") for name in names)
    write_details(tmp_path, dict.fromkeys(names, 1.0))
    scene = load_scene(tmp_path)
    assert sorted(view.name for view in [*scene.train, *scene.test]) == sorted(names)
    for other in ("a b.png", "a_b.png", "_a_b.png"):
        shutil.copy(tmp_path / names[1], tmp_path / other)
    write_details(tmp_path, {})  # copies stay
    found = looked_at(tmp_path).colmap_names
    assert found["a_b.png"] == "a_b.png"
    assert sorted(found.values()) == sorted([*names, "a b.png", "a_b.png", "_a_b.png"])


def test_numbered_photos_are_no_copies(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    plain = np.full((48, 64, 3), 200)
    plain[16:32, 24:40] = 30
    for k in range(4):  # much alike, as of a thing on a turntable
        Image.fromarray((plain + rng.integers(0, 9, plain.shape)).astype(np.uint8)).save(
            tmp_path / f"vase ({k}).png"
        )
    assert len(looked_at(tmp_path).names) == 4


def test_grey_photos_of_16_bits_are_seen(cards: Scene, tmp_path: Path) -> None:
    for k, view in enumerate(sorted([*cards.train, *cards.test], key=lambda view: view.name)):
        levels = view.image.astype(np.float64).mean(2)
        Image.fromarray((257 * levels).astype(np.uint16)).save(tmp_path / f"{k}.png")
    with Image.open(tmp_path / "0.png") as photo:
        assert 20 < np.asarray(grey(photo)).mean() < 235
    assert 20 < glance(tmp_path / "0.png").small.mean() < 235
    scene = load_scene(tmp_path)
    assert len(scene.train) + len(scene.test) == 9
    Image.fromarray(np.ones((4, 4), np.float32)).save(tmp_path / "x.tif")
    with pytest.raises(UnreadableError, match="pixels are floating-point"):
        glance(tmp_path / "x.tif")


def test_links_to_photos_that_were_moved_are_made_anew(
    found_cards: tuple[Path, Scene], tmp_path: Path
) -> None:
    folder, before = found_cards
    (kept,) = (folder / "kept").iterdir()
    keep = tmp_path / "kept"
    left = keep / f".{kept.name}"  # as a call that was stopped leaves it
    for inner in ("photos", "masks"):
        (left / inner).mkdir(parents=True)
    for k in range(9):
        (left / "photos" / f"{k}.png").symlink_to(tmp_path / "gone" / f"{k}.png")
    again = load_scene(folder / "photos", keep_sfm=keep)
    assert len(again.train) == len(before.train)
    assert [path.name for path in keep.iterdir()] == [kept.name]


def test_faces_of_a_photo_are_one_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, told, asked = make_truth(count=12), dict[Path, Exif](), list[Path]()
    rng = np.random.default_rng(0)
    photos = []
    for k, viewmat in enumerate(truth.viewmats):
        x, y, z = (-viewmat[:3, :3].T @ viewmat[:3, 3] + rng.normal(0, 0.3, 3)).tolist()
        told[tmp_path / str(k)] = Exif(
            gps=(NORTH + 5 * z / METRES[0], EAST + 5 * x / METRES[1], 320 - 5 * y), above=9 - 5 * y
        )
        photos += [Photo(f"{k}.{face}", tmp_path / str(k), None, viewmat, None) for face in ("left", "right")]  # pyright: ignore[reportArgumentType]

    def tags(path: Path) -> Exif:
        asked.append(path)
        return told[path]

    monkeypatch.setattr(place, "read_exif", tags)
    capture = Capture("photos", photos, 1.0, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    both, one = place.located(capture), place.located(replace(capture, photos=photos[::2]))
    assert len(asked) == 24
    assert both == one
    first = tmp_path / "0"
    told[first] = replace(told[first], gps=(*(told[first].gps or (0, 0))[:2], float("nan")))
    assert place.located(capture) is not None  # one altitude less: barometers still tell


def test_places_on_both_sides_of_the_date_line() -> None:
    rng = np.random.default_rng(1)
    metres = rng.normal(size=(10, 3)) * [40, 40, 10]
    east = 180 + metres[:, 0] / (METRES[0] * np.cos(np.radians(17)))
    gps = [
        (-17 + y / METRES[0], float((e + 180) % 360 - 180), 5 + z)
        for (_, y, z), e in zip(metres.tolist(), east, strict=True)
    ]
    assert min(place[1] for place in gps) < -179 < 179 < max(place[1] for place in gps)
    found = georeference(metres, gps)
    assert found is not None
    np.testing.assert_allclose(found.up, [0, 0, 1], atol=0.02)
    assert found.scale == pytest.approx(1, rel=0.02)


def test_lists_of_a_split_know_folders(tmp_path: Path) -> None:
    (tmp_path / "split.json").write_text('{"seed": 3}')
    (tmp_path / "test.txt").write_text("cam2/001.png\ncam2/002.png\n")
    split = listed_split([tmp_path], tmp_path)
    assert split is not None
    assert split.test == ["cam2/001.png", "cam2/002.png"]
    known = names_by_any(["cam1/001.png", "cam1/002.png", "cam2/002.png"])  # cam2/001 has no pose
    assert not replace(split, test=["cam2/001.png"]).names_any(known)
    for name in ("cam1/001.png", "x/cam1/001.jpg", "001"):
        assert replace(split, test=[name]).names_any(known), name
    assert replace(split, test=["images/7.png"]).names_any(names_by_any(["7.png"]))


def test_photos_without_a_feature_have_no_likely_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    from hqgs.scene.sfm import likely

    monkeypatch.setattr(likely, "_largest", lambda db, number: np.zeros((0, 128), np.float32))
    assert likely_pairs(None, 3).shape[1] == 2  # pyright: ignore[reportArgumentType]


def test_two_known_cameras_have_points() -> None:
    views = views_of(336, 252, 5, first=2)
    found = triangulated(views)
    assert isinstance(found, SparsePoints), found
    assert len(found.points) > 50
    assert np.median(depth_error(views, found.points)) < 0.02


def test_a_film_that_does_not_tell_its_length(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(40)]
    film = encoded(tmp_path / "a.mp4", images, 20, times=[1000 * k for k in range(40)])
    with av.open(str(film)) as source, av.open(str(tmp_path / "a.mkv"), "w", options={"live": "1"}) as out:
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    with av.open(str(tmp_path / "a.mkv")) as live:
        assert not live.duration
    folder, _ = film_frames(tmp_path / "a.mkv", tmp_path / "frames", 8)
    numbers = sorted(int(path.stem) for path in folder.glob("*.jpg"))
    assert len(numbers) == 8
    assert max(np.diff(numbers)) < 11


def test_a_mask_of_printing_inks_is_not_inverted(tmp_path: Path) -> None:
    mask = np.zeros((8, 16, 3), np.uint8)
    mask[:, 8:] = 255
    Image.fromarray(mask).convert("CMYK").save(tmp_path / "m.tif")
    counts = decode_mask(tmp_path / "m.tif", 16, 8)
    assert counts[:, 8:].all()
    assert not counts[:, :8].any()


def test_the_focal_length_of_a_turned_photo(tmp_path: Path) -> None:
    focal = []
    for size in ((90, 60), (60, 90)):
        tags = Image.Exif()
        tags.get_ifd(0x8769).update(
            {37386: 50.0, 40962: 60 * size[0], 40963: 60 * size[1], 41486: 3600.0, 41488: 3}
        )
        Image.new("RGB", size).save(tmp_path / "a.jpg", exif=tags)
        focal.append(read_exif(tmp_path / "a.jpg").focal)
    assert focal[0] == pytest.approx(focal[1])
    assert focal[0] > 0
