"""COLMAP scenes: cameras, models, photos by name, damaged files."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fixtures_scenes import make_truth, subset, write_colmap, write_photos
from PIL import Image

from hqgs.scene.load import load_scene

BINARY = ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("model", ["sparse/0", "sparse", "."])
def test_cameras_points_and_photos(tmp_path: Path, binary: bool, model: str) -> None:
    truth = make_truth()
    scene = load_scene(write_colmap(truth, tmp_path / "scene", binary=binary, model=model), test_every=4)
    assert (scene.name, scene.source) == ("scene", "colmap")
    assert [v.name for v in scene.test] == ["view_00.png", "view_04.png", "view_08.png"]
    assert [v.name for v in scene.train] == [n for i, n in enumerate(truth.names) if i % 4]
    for view in scene.train + scene.test:
        i = truth.names.index(view.name)
        np.testing.assert_allclose(view.camera.viewmat, truth.viewmats[i], atol=1e-12)
        np.testing.assert_array_equal(view.camera.K, truth.K)
        assert (view.camera.width, view.camera.height) == (48, 36)
        np.testing.assert_array_equal(view.image, truth.photos[i])
        assert view.image.dtype == np.uint8
        assert view.mask is None
    np.testing.assert_array_equal(scene.points, truth.points)
    np.testing.assert_array_equal(scene.point_colors, truth.colors)
    assert scene.notes == []


def test_pose_by_hand(tmp_path: Path) -> None:
    """A quarter turn about y: the world's x axis is what the camera sees as -z, its z as x."""
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 16 16 20 8 8\n")
    half = np.sqrt(0.5)
    (tmp_path / "images.txt").write_text(f"1 {half} 0 {half} 0 1 2 3 1 a.png\n\n")
    (tmp_path / "points3D.txt").write_text("1 -5 0 0 10 20 30 0\n")
    (tmp_path / "images").mkdir()
    Image.new("RGB", (16, 16)).save(tmp_path / "images" / "a.png")
    camera = load_scene(tmp_path, test_every=0).train[0].camera
    expected = [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(camera.viewmat, expected, atol=1e-12)
    np.testing.assert_allclose(camera.center, [3, -2, -1], atol=1e-12)


def test_the_largest_model_is_taken(tmp_path: Path) -> None:
    truth = make_truth()
    write_colmap(subset(truth, [0, 1, 2]), tmp_path, model="sparse/0")
    write_colmap(subset(truth, [0, 2, 3, 4, 5, 6]), tmp_path, model="sparse/1", binary=False)
    write_photos(truth, tmp_path / "images")
    scene = load_scene(tmp_path, test_every=0)
    assert [v.name for v in scene.train] == [truth.names[i] for i in (0, 2, 3, 4, 5, 6)]
    assert "took the largest, sparse/1, with 6 photos" in scene.notes[0]
    assert "3 photos have no camera" in scene.notes[1]
    assert "view_01.png, view_07.png, view_08.png" in scene.notes[1]


def test_photos_in_subfolders_and_with_another_suffix(tmp_path: Path) -> None:
    truth = make_truth(3)
    named = replace(truth, names=["left/a.jpg", "left/b.jpg", "right/a.jpg"])
    write_colmap(named, tmp_path, images=None)
    write_photos(truth, tmp_path / "images", ["left/a.png", "left/b.png", "right/a.png"])
    scene = load_scene(tmp_path, test_every=0)
    assert [v.name for v in scene.train] == named.names
    for view, photo in zip(scene.train, truth.photos, strict=True):
        np.testing.assert_array_equal(view.image, photo)


def test_images_n_replaces_scaling(tmp_path: Path) -> None:
    """Photos from images_4, under other names; the true sizes (13 x 9 for 48 x 36) scale the intrinsics."""
    truth = make_truth(5, ".jpg")
    write_colmap(truth, tmp_path)
    small = [np.full((9, 13, 3), 10 * i, np.uint8) for i in range(5)]
    write_photos(replace(truth, photos=small), tmp_path / "images_4", [f"image{i:03d}.png" for i in range(5)])
    scene = load_scene(tmp_path, downscale=4, test_every=0)
    for i, view in enumerate(scene.train):
        assert view.name == truth.names[i]
        np.testing.assert_array_equal(view.image, small[i])
        np.testing.assert_allclose(view.camera.K, np.diag([13 / 48, 9 / 36, 1]) @ truth.K)
    assert "images_4" in scene.notes[0]
    assert "photos were assigned in sorted order" in scene.notes[1]
    assert load_scene(tmp_path, downscale=3, test_every=0).train[0].camera.width == 16  # images, scaled


def test_hold_counts_unregistered_photos(tmp_path: Path) -> None:
    """The third photo (blurred) has no camera: the held-out ones are still 0, 4 and 8 of the folder."""
    truth = make_truth()
    write_colmap(subset(truth, [0, 1, 3, 4, 5, 6, 7, 8]), tmp_path)
    write_photos(truth, tmp_path / "images")
    (tmp_path / "hold=4").touch()
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.test] == ["view_00.png", "view_04.png", "view_08.png"]
    assert any("hold=4" in n for n in scene.notes)


def test_no_points_falls_back_to_random_ones(tmp_path: Path) -> None:
    truth = make_truth()
    empty = replace(truth, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    scene = load_scene(write_colmap(empty, tmp_path))
    assert len(scene.points) == 20_000
    assert "20000 random points" in scene.notes[0]


def test_points_that_are_not_finite_are_dropped(tmp_path: Path) -> None:
    truth = make_truth()
    write_colmap(truth, tmp_path)
    path = tmp_path / "sparse/0/points3D.bin"
    data = bytearray(path.read_bytes())
    first = struct.unpack_from("<Q", data, 8)[0] - 1
    struct.pack_into("<d", data, 8 + 8, np.nan)
    path.write_bytes(data)
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.points, np.delete(truth.points, first, 0))
    np.testing.assert_array_equal(scene.point_colors, np.delete(truth.colors, first, 0))
    assert scene.notes == ["1 of 12 points are NaN or Inf and were left out"]


def test_missing_photos_are_left_out_and_named(tmp_path: Path) -> None:
    """The test views stay those of the whole model; a folder that lost most of it is refused."""
    write_colmap(make_truth(), tmp_path)
    whole = load_scene(tmp_path)
    (tmp_path / "images/view_05.png").unlink()
    (tmp_path / "images/view_08.png").unlink()
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.train] == [v.name for v in whole.train if v.name != "view_05.png"]
    assert [v.name for v in scene.test] == ["view_00.png"]
    wanted = "2 of 9 cameras have no photo any more and were left out: view_05.png, view_08.png"
    assert wanted in scene.notes
    for k in (1, 2, 3):
        (tmp_path / f"images/view_{k:02d}.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"5 of 9 cameras have no photo in .*images: view_01\.png"):
        load_scene(tmp_path)


def test_duplicate_names(tmp_path: Path) -> None:
    truth = make_truth(4)
    doubled = replace(truth, names=["a.png", "b.png", "b.png", "c.png"])
    with pytest.raises(ValueError, match=r"more than once: b\.png"):
        load_scene(write_colmap(doubled, tmp_path, binary=False))


def test_two_cameras_for_one_file(tmp_path: Path) -> None:
    """Only b.tif is there for two cameras; a photo with a camera of its own is nobody else's."""
    truth = replace(make_truth(4), names=["a.png", "b.jpg", "b.png", "c.png"])
    write_colmap(truth, tmp_path)
    (tmp_path / "images/b.jpg").unlink()
    assert "left out: b.jpg" in load_scene(tmp_path).notes[-1]
    (tmp_path / "images/b.png").replace(tmp_path / "images/b.tif")
    with pytest.raises(ValueError, match=r"the same photo: b\.jpg, b\.png"):
        load_scene(tmp_path)


def test_rotated_photo(tmp_path: Path) -> None:
    write_colmap(make_truth(), tmp_path)
    path = tmp_path / "images/view_03.png"
    with Image.open(path) as photo:
        photo.transpose(Image.Transpose.ROTATE_90).save(path)
    with pytest.raises(ValueError, match=r"'view_03\.png' is 36 x 48, but its camera is for 48 x 36"):
        load_scene(tmp_path)


def test_model_without_photos(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="COLMAP model but no photos: looked for images, images_2"):
        load_scene(write_colmap(make_truth(), tmp_path, images=None), downscale=2)


@pytest.mark.parametrize("gone", ["rigs.bin", "frames.bin", "frames.txt"])
def test_frames_without_rigs_leave_the_photos_their_poses(tmp_path: Path, gone: str) -> None:
    truth = make_truth()
    write_colmap(truth, tmp_path, binary=gone.endswith("bin"))
    if gone.endswith("bin"):
        (tmp_path / "sparse/0" / gone).unlink()
    else:
        (tmp_path / "sparse/0/rigs.txt").write_text("1 1 CAMERA 1\n")
    scene = load_scene(tmp_path, test_every=0)
    assert f"no {gone}: the photos' own poses are used" in scene.notes[0]
    for view, viewmat in zip(scene.train, truth.viewmats, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, viewmat, atol=1e-12)


def left_out(root: Path) -> str:
    notes = load_scene(root).notes
    return next(note for note in notes if note.startswith("1 of 9 photos have no pose"))


def test_photos_without_a_pose_are_named(tmp_path: Path) -> None:
    truth = make_truth()
    write_colmap(truth, tmp_path)
    for name in ("rigs.bin", "frames.bin"):  # the classic three files, where the image holds the pose
        (tmp_path / "sparse/0" / name).unlink(missing_ok=True)
    path = tmp_path / "sparse/0/images.bin"
    data = path.read_bytes()
    start = data.index(b"view_02.png") - 64
    for offset, value in ((4, np.nan), (36, np.nan), (36, np.inf)):  # the quaternion's w, then a translation
        spoilt = bytearray(data)
        struct.pack_into("<d", spoilt, start + offset, value)
        path.write_bytes(spoilt)
        assert "view_02.png" in left_out(tmp_path)
    zero = bytearray(data)
    struct.pack_into("<4d", zero, start + 4, 0, 0, 0, 0)
    path.write_bytes(zero)
    assert "view_02.png" in left_out(tmp_path)
    longer = bytearray(data)
    quaternion = np.array(struct.unpack_from("<4d", data, start + 4))
    struct.pack_into("<4d", longer, start + 4, *(3 * quaternion))
    path.write_bytes(longer)
    scene = load_scene(tmp_path, test_every=0)
    np.testing.assert_allclose(scene.train[2].camera.viewmat, truth.viewmats[2], atol=1e-9)


@pytest.mark.parametrize("change", ["16 x 10^12", "f = -1", "f = nan"])
def test_impossible_camera(tmp_path: Path, change: str) -> None:
    write_colmap(make_truth(), tmp_path)
    path = tmp_path / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    if change.startswith("16"):
        struct.pack_into("<Q", data, 16, 10**12)
    else:
        struct.pack_into("<d", data, 32, float(change[4:]))
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"view_00\.png|cameras"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", [*BINARY, "rigs.bin", "frames.bin"])
@pytest.mark.parametrize("damage", ["count", "huge", "short", "long", "empty"])
def test_damaged_binary_file(tmp_path: Path, name: str, damage: str) -> None:
    write_colmap(make_truth(), tmp_path)
    path = tmp_path / "sparse/0" / name
    if not path.exists():
        pytest.skip(f"this pycolmap writes no {name}")
    data = path.read_bytes()
    count = struct.unpack_from("<Q", data)[0]
    path.write_bytes(
        {
            "count": struct.pack("<Q", count + 1) + data[8:],
            "huge": struct.pack("<Q", 10**12) + data[8:],
            "short": data[:-3],
            "long": data + b"\0\0\0\0",
            "empty": b"",
        }[damage]
    )
    with pytest.raises(ValueError, match=re.escape(name)):
        load_scene(tmp_path)


@pytest.mark.parametrize(("name", "tail"), [("points3D.bin", 8), ("images.bin", 32), ("frames.bin", 20)])
def test_inner_counts_are_checked(tmp_path: Path, name: str, tail: int) -> None:
    """The count inside the last record (track, 2D points, frame data) is raised to 2^31."""
    write_colmap(make_truth(), tmp_path)
    path = tmp_path / "sparse/0" / name
    if not path.exists():
        pytest.skip(f"this pycolmap writes no {name}")
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, len(data) - tail, 2**31)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"{name} is damaged: it ends inside a record"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_damaged_text_file(tmp_path: Path, name: str) -> None:
    write_colmap(make_truth(), tmp_path, binary=False)
    (tmp_path / "sparse/0" / name).write_bytes(b"1 two \xff\xfe three\n")
    with pytest.raises(ValueError, match="sparse/0"):
        load_scene(tmp_path)


def test_extra_rig_sensors_are_walked(tmp_path: Path) -> None:
    """A rig of two cameras, the second with a pose in the rig: the check must step over both kinds."""
    if not hasattr(pycolmap, "Rig"):
        pytest.skip("this pycolmap has no rigs")
    truth = make_truth(2)
    folder = write_colmap(truth, tmp_path) / "sparse/0"
    rig = struct.pack("<QII", 1, 1, 2) + struct.pack("<iI", 0, 7) + struct.pack("<iIB7d", 0, 8, 1, *range(7))
    (folder / "rigs.bin").write_bytes(rig + b"x")
    with pytest.raises(ValueError, match="goes on after its 1 records"):
        load_scene(tmp_path)
    (folder / "rigs.bin").write_bytes(rig[:-1])
    with pytest.raises(ValueError, match="ends inside a record"):
        load_scene(tmp_path)
