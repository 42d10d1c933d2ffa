"""One bad part refuses nothing: names that are no UTF-8, links, file systems without locks or flushes."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_photos import looked_at
from fixtures_scenes import Truth, make_truth, write_colmap, write_llff, write_photos, write_transforms
from PIL import Image

from hqgs.base.files import atomic_path, keep_folder, lock_folder, write_json, write_text
from hqgs.scene.load import load_scene
from hqgs.scene.photo_files import below
from hqgs.scene.scene import Scene

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
