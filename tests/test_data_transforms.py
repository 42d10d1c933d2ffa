"""transforms.json of nerfstudio and instant-ngp, and Blender sets."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
from fixtures_scenes import FX, FY, HEIGHT, WIDTH, frames, make_truth, subset, write_photos, write_transforms
from PIL import Image

from hqgs.scene.geometry import resized
from hqgs.scene.load import load_scene


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray | None, text: bool = False) -> None:
    kinds = [(k, "f4") for k in "xyz"] + [(k, "u1") for k in ("red", "green", "blue") if colors is not None]
    vertex = np.zeros(len(points), kinds)
    for k, column in zip("xyz", points.T, strict=True):
        vertex[k] = column
    if colors is not None:
        for k, column in zip(("red", "green", "blue"), colors.T, strict=True):
            vertex[k] = column
    plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")], text=text).write(path)


@pytest.mark.parametrize("text", [True, False])
def test_cameras_and_points(tmp_path: Path, text: bool) -> None:
    truth = make_truth()
    write_transforms(truth, tmp_path, ply_file_path="points.ply")
    write_ply(tmp_path / "points.ply", truth.points, truth.colors, text)
    scene = load_scene(tmp_path)
    assert scene.source == "transforms"
    assert [v.name for v in scene.test] == ["images/view_00.png", "images/view_08.png"]
    for view in scene.train + scene.test:
        i = truth.names.index(view.name.removeprefix("images/"))
        np.testing.assert_allclose(view.camera.viewmat, truth.viewmats[i], atol=1e-12)
        np.testing.assert_array_equal(view.camera.K, truth.K)
        np.testing.assert_array_equal(view.image, truth.photos[i])
    np.testing.assert_allclose(scene.points, truth.points, rtol=1e-6)
    np.testing.assert_array_equal(scene.point_colors, truth.colors)
    assert scene.notes == []


def test_pose_by_hand(tmp_path: Path) -> None:
    """OpenGL's identity pose looks along the world's -z with y up."""
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    frame["transform_matrix"][2][3] = 4.0
    Image.new("RGB", (16, 16)).save(tmp_path / "a.png")
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 20.0, "frames": [frame]}))
    camera = load_scene(tmp_path, test_every=0).train[0].camera
    np.testing.assert_allclose(camera.viewmat @ [1, 2, 1, 1], [1, -2, 3, 1])
    np.testing.assert_allclose(camera.K, [[20, 0, 8], [0, 20, 8], [0, 0, 1]])


def test_angle_of_view_and_defaults(tmp_path: Path) -> None:
    """instant-ngp with an angle only: one focal length, the middle as principal point, the photo's size."""
    values: dict[str, Any] = dict.fromkeys(["fl_x", "fl_y", "cx", "cy", "w", "h"])
    angle = 2 * math.atan(WIDTH / 2 / FX)
    scene = load_scene(write_transforms(make_truth(2), tmp_path, **values, camera_angle_x=angle))
    np.testing.assert_allclose(
        scene.train[0].camera.K, [[FX, 0, WIDTH / 2], [0, FX, HEIGHT / 2], [0, 0, 1]], rtol=1e-12
    )
    assert "a guessed depth range" in scene.notes[0]


def test_frame_overrides_and_other_size(tmp_path: Path) -> None:
    """One frame has its own focal length; all are declared at twice the size of the photos."""
    truth = make_truth(3)
    entries = frames(truth)
    entries[1] |= {"fl_x": 90.0, "cx": 50.0}
    values = {"fl_x": 2 * FX, "fl_y": 2 * FY, "cx": 50.0, "cy": 35.0, "w": 2 * WIDTH, "h": 2 * HEIGHT}
    scene = load_scene(write_transforms(truth, tmp_path, **values, frames=entries), test_every=0)
    np.testing.assert_allclose(scene.train[0].camera.K, truth.K)
    np.testing.assert_allclose(scene.train[1].camera.K[0], [45, 0, 25])
    np.testing.assert_allclose(scene.train[1].camera.K[1], truth.K[1])


K = [[FX, 0, 25.0], [0, FY, 17.5], [0, 0, 1]]
MATRICES: dict[str, dict[str, Any]] = {
    "K": {"K": K},
    "flat": {"camera_intrinsics": np.ravel(K).tolist()},
    "columns": {"intrinsic_matrix": np.transpose(K).ravel().tolist()},
    "four": {"intrinsics": [FX, FY, 25.0, 17.5]},
    "4x4": {"camera_matrix": np.block([[np.array(K), np.zeros((3, 1))], [np.eye(4)[3:]]]).tolist()},
    "names": {"intrinsics": {"fx": FX, "fy": FY, "cx": 25.0, "cy": 17.5, "width": WIDTH, "height": HEIGHT}},
    "fx": {"fx": FX, "fy": FY, "cx": 25.0, "cy": 17.5},
}


@pytest.mark.parametrize("of_frame", [False, True])
@pytest.mark.parametrize("form", MATRICES)
def test_intrinsics_by_other_names_and_as_matrices(tmp_path: Path, form: str, of_frame: bool) -> None:
    """A frame's own wins over the file's, whatever either calls it."""
    truth = make_truth(2)
    none: dict[str, Any] = dict.fromkeys(["fl_x", "fl_y", "cx", "cy", "w", "h"])
    if of_frame:
        entries = [frame | MATRICES[form] for frame in frames(truth)]
        write_transforms(truth, tmp_path, **none | {"fl_x": 77.0, "cx": 3.0}, frames=entries)
    else:
        write_transforms(truth, tmp_path, **none | MATRICES[form])
    for view in load_scene(tmp_path, test_every=0).train:
        np.testing.assert_allclose(view.camera.K, K)


def test_distortion_as_opencv_lists_it(tmp_path: Path) -> None:
    truth = make_truth(2)
    plain = write_transforms(truth, tmp_path / "a", k1=0.1, k2=0.02, p1=1e-3, p2=2e-3)
    listed = write_transforms(truth, tmp_path / "b", dist_coeffs=[[0.1, 0.02, 1e-3, 2e-3, 0.0]])
    for a, b in zip(load_scene(plain).train, load_scene(listed).train, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
    for wrong in ({"K": [[1, 2], [3, 4]]}, {"K": "x"}, {"K": [[FX, 9, 1], [0, FY, 1], [0, 0, 1]]}):
        with pytest.raises(ValueError, match="K"):
            load_scene(write_transforms(truth, tmp_path / "c", fl_x=None, **wrong))
    with pytest.raises(ValueError, match="distortion must be"):
        load_scene(write_transforms(truth, tmp_path / "c", distortion=[0, 0, 0, 0, 0, 1]))


@pytest.mark.parametrize("entry", ["images/a", "./images/a", "sub/../images/a.png", "{root}/images/a.png"])
def test_file_path_forms(tmp_path: Path, entry: str) -> None:
    truth = make_truth(1)
    write_photos(truth, tmp_path / "images", ["a.png"])
    path = entry.replace("{root}", str(tmp_path))
    write_transforms(truth, tmp_path, frames=[frames(truth)[0] | {"file_path": path}])
    scene = load_scene(tmp_path, test_every=0)
    assert scene.train[0].name == "images/a.png"
    np.testing.assert_array_equal(scene.train[0].image, truth.photos[0])


def test_blender_set(tmp_path: Path) -> None:
    """RGBA photos: what is transparent is empty, black behind; the files name the split."""
    truth = make_truth(6)
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[5:30, 10:40] = 255
    alpha[5, 10:40] = 127
    alpha[6, 10:40] = 128
    angle = 2 * math.atan(WIDTH / 2 / FX)
    for split, keep in (("train", [1, 0, 2, 5]), ("test", [3, 4])):
        part = subset(truth, keep)
        entries = frames(part, f"./{split}")
        for i, entry in enumerate(entries):
            entry["file_path"] = f"./{split}/r_{i}"
            path = tmp_path / split / f"r_{i}.png"
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(np.dstack([part.photos[i], alpha])).save(path)
        meta = {"camera_angle_x": angle, "frames": entries}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(meta))
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.train] == [f"train/r_{i}.png" for i in range(4)]
    assert [v.name for v in scene.test] == ["test/r_0.png", "test/r_1.png"]
    np.testing.assert_allclose(scene.test[1].camera.viewmat, truth.viewmats[4], atol=1e-12)
    for view, photo in zip(
        scene.train + scene.test, [truth.photos[k] for k in (1, 0, 2, 5, 3, 4)], strict=True
    ):
        assert view.mask is None
        np.testing.assert_array_equal(view.image, np.rint(photo * (alpha[..., None] / 255)).astype(np.uint8))
        np.testing.assert_array_equal(view.empty, 255 - alpha)
    small = load_scene(tmp_path, downscale=2).train[0]
    assert small.empty is not None
    shown = (255.0 - alpha).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean((1, 3))
    np.testing.assert_allclose(small.empty, shown, atol=0.5)
    np.testing.assert_array_equal(resized(scene.train[0], WIDTH // 2, HEIGHT // 2).empty, small.empty)
    assert any("the 6 photos have transparent pixels" in note for note in scene.notes)
    assert "the test views are the 2 of transforms_test.json" in scene.notes[0]
    # The random points were drawn where the masks count, around the point all cameras look at.
    assert len(scene.points) == 20_000
    inside = np.linalg.norm(scene.points, axis=1) < 2
    assert inside.mean() > 0.2
    (tmp_path / "transforms_test.json").unlink()
    assert len(load_scene(tmp_path, test_every=2).test) == 2


def test_random_points_of_parallel_cameras(tmp_path: Path) -> None:
    """No common point to look at: depths reach from half to 50 times the radius of the positions."""
    truth = make_truth(4)
    entries = frames(truth)
    for i, entry in enumerate(entries):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * i  # centres at 0, 2, 4, 6: radius 3
        entry["transform_matrix"] = pose.tolist()
    scene = load_scene(write_transforms(truth, tmp_path, frames=entries), test_every=0)
    depth = -scene.points[:, 2]
    assert 1.5 - 1e-5 < depth.min() < 1.6
    assert 140 < depth.max() < 150 + 1e-3
    assert len(np.unique(scene.points, axis=0)) == 20_000


def test_masks(tmp_path: Path) -> None:
    truth = make_truth(4)
    write_transforms(truth, tmp_path)
    left = np.zeros((HEIGHT, WIDTH), np.uint8)
    left[:, :20] = 1  # any value but zero counts
    half = left[::2, ::2]  # a mask of half the size
    (tmp_path / "masks").mkdir()
    Image.fromarray(left).save(tmp_path / "masks/view_01.png")
    Image.fromarray(left).save(tmp_path / "masks/view_02.png.png")
    Image.fromarray(half).save(tmp_path / "half.png")
    entries = frames(truth)
    entries[3]["mask_path"] = "half.png"
    write_transforms(truth, tmp_path, frames=entries)
    views = load_scene(tmp_path, test_every=0).train
    assert views[0].mask is None
    for view in views[1:]:
        assert view.mask is not None
        np.testing.assert_array_equal(view.mask, left.astype(bool))
    Image.fromarray(left.T.copy()).save(tmp_path / "masks/view_01.png")
    with pytest.raises(ValueError, match=r"mask .*view_01\.png is 36 x 48, its photo 48 x 36"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("values", "model", "params"),
    [
        ({"k1": 0.0}, "PINHOLE", []),
        ({"k1": -0.1, "k2": 0.02, "p1": 0.01, "p2": -0.01}, "OPENCV", [-0.1, 0.02, 0.01, -0.01]),
        ({"k1": -0.1, "k3": 0.01}, "FULL_OPENCV", [-0.1, 0, 0, 0, 0.01, 0, 0, 0]),
        ({"k1": 0.1, "k4": 0.01, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE", [0.1, 0, 0, 0.01]),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", [0, 0, 0, 0]),
    ],
)
def test_distorted_cameras(
    tmp_path: Path, values: dict[str, Any], model: str, params: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera handed to the undistortion; that itself is tested in test_data_undistort.py."""
    import hqgs.scene.load as data

    seen = []
    real = data.load_views
    monkeypatch.setattr(data, "load_views", lambda p, *rest: seen.extend(p) or real(p, *rest))
    scene = load_scene(write_transforms(make_truth(2), tmp_path, **values), test_every=0)
    assert [p.camera.model.name for p in seen] == [model] * 2
    np.testing.assert_allclose(seen[0].camera.params[4:], params)
    assert (scene.train[0].image.shape == (HEIGHT, WIDTH, 3)) == (model == "PINHOLE")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"k4": 0.1}, r"frame 0 \(images/view_00\.png\): k4 = 0\.1 is not defined"),
        ({"k1": "a"}, "k1 must be a finite number, got 'a'"),
        ({"fl_x": float("nan")}, "fl_x must be a finite number, got nan"),
        ({"cx": 10**400}, "cx must be a finite number"),
        ({"fl_x": -3.0}, r"view_00\.png' \(PINHOLE\) has the parameters \[-3\.0"),
        ({"w": 10**9}, "w, h = 1000000000.0"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "angle of view 4.0 is not between"),
        ({"camera_model": "SPHERICAL"}, "camera_model 'SPHERICAL' is none of"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "not an OpenCV fisheye"),
        ({"frames": []}, "list 'frames' that is not empty"),
        ({"frames": [3]}, "frame 0: expected an object, got 3"),
        ({"frames": [{"file_path": 7}]}, "file_path must be a path, got 7"),
        ({"ply_file_path": 7}, "ply_file_path must be a path"),
    ],
)
def test_bad_values(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_scene(write_transforms(make_truth(2), tmp_path, **values))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1, 2], [3, 4]], r"must be 4 x 4, got shape \[2, 2\]"),
        ([[1, 2], [3]], "must be numbers"),
        ([[10**400] * 4] * 4, "must be numbers"),
        ("abc", "must be numbers"),
        (np.diag([1, 1, 1, 2]).tolist(), "last row"),
        (np.diag([1, 1, -1, 1]).tolist(), "no rotation"),
        (np.diag([1, 1, 2, 1]).tolist(), "no rotation"),
        ([[1, 0, 0, 1e20], [0, 1, 0, 0], [0, 0, 1, 0]], "beyond 1e\\+15"),
    ],
)
def test_bad_matrix_names_the_photo(tmp_path: Path, matrix: object, message: str) -> None:
    truth = make_truth(2)
    entries = frames(truth)
    entries[1]["transform_matrix"] = matrix
    with pytest.raises(ValueError, match=f"view_01.*{message}"):
        load_scene(write_transforms(truth, tmp_path, frames=entries))


def test_a_pose_with_few_digits_becomes_a_rotation(tmp_path: Path) -> None:
    truth = make_truth(2)
    entries = frames(truth)
    for entry in entries:
        entry["transform_matrix"] = np.round(entry["transform_matrix"], 3).tolist()
    write_transforms(truth, tmp_path, frames=entries)
    for view, viewmat in zip(load_scene(tmp_path, test_every=0).train, truth.viewmats, strict=True):
        R = view.camera.viewmat[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(R, viewmat[:3, :3], atol=2e-3)


def test_missing_files_and_duplicates(tmp_path: Path) -> None:
    truth = make_truth(3)
    entries = frames(truth)
    moved = entries[1] | {"transform_matrix": entries[2]["transform_matrix"]}
    write_transforms(truth, tmp_path, frames=[*entries, moved])
    with pytest.raises(
        ValueError, match=r"'images/view_01\.png' appears more than once, with different poses"
    ):
        load_scene(tmp_path)
    write_transforms(truth, tmp_path, frames=[*entries, entries[1]], ply_file_path="none.ply")
    scene = load_scene(tmp_path)
    assert len(scene.train) + len(scene.test) == 3
    assert scene.notes[0].startswith("ply_file_path 'none.ply' is not a file in")
    write_transforms(truth, tmp_path)
    (tmp_path / "images/view_02.png").unlink()
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.train + scene.test] == ["images/view_01.png", "images/view_00.png"]
    assert "1 of 3 cameras have no photo any more and were left out: images/view_02.png" in scene.notes


def test_ply_without_colours_and_with_points_that_are_not_finite(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, np.inf], [6, 7, 8.0]])
    write_transforms(make_truth(2), tmp_path, ply_file_path="p.ply")
    write_ply(tmp_path / "p.ply", points, None)
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.points, points[[0, 3]].astype(np.float32))
    np.testing.assert_array_equal(scene.point_colors, np.full((2, 3), 128))
    assert scene.notes == [
        "2 of 4 points are NaN or Inf and were left out",
        "the points have one colour: whether photos show them where they are was not checked",
    ]


HEADER = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\n{}end_header\n"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\n",
        HEADER.format("binary_little_endian", 10**12, "property float z\n").encode() + b"\0" * 100,
        HEADER.format("ascii", 10**12, "property float z\n").encode() + b"1 2 3\n",
        HEADER.format("ascii", 100, "property float z\n" + "property float w\n" * 9).encode() + b"1 2 3\n",
        HEADER.format("binary_little_endian", 5, "property float z\n").encode() + b"\0" * 50,
        HEADER.format("ascii", "-1", "property float z\n").encode(),
        HEADER.format("ascii", 1, "").encode() + b"1 2\n",
        HEADER.format("ascii", 1, "property list uchar float z\n").encode() + b"1 2 1 3\n",
        HEADER.format("ascii", 1, "property float z\n").encode() + b"1 2 x\n",
    ],
)
def test_bad_ply_names_the_file(tmp_path: Path, content: bytes) -> None:
    write_transforms(make_truth(2), tmp_path, ply_file_path="p.ply")
    (tmp_path / "p.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"p\.ply"):
        load_scene(tmp_path)
