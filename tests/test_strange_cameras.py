"""Files of cameras as people bring them: read as they were meant, or one sentence says what is wrong."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_scenes import FX, FY, make_truth, write_colmap, write_transforms
from plyfile import PlyData, PlyElement

from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene

TRUTH = make_truth()
Change = Callable[[Path], None]


def poses(change: Callable[[np.ndarray], Any]) -> Change:
    """Every transform_matrix of a nerfstudio scene, changed."""
    return frames(lambda fs: [f | {"transform_matrix": change(np.array(f["transform_matrix"]))} for f in fs])


def values(**changed: Any) -> Change:
    return lambda root: void(write_transforms(TRUTH, root, **changed))


def void(_: object) -> None:
    return None


def utf16(root: Path) -> None:
    text = (root / "transforms.json").read_text()
    (root / "transforms.json").write_bytes(text.encode("utf-16"))


def frames(change: Callable[[list[dict[str, Any]]], Any]) -> Change:
    """The list of frames, changed."""

    def made(root: Path) -> None:
        meta = json.loads((root / "transforms.json").read_text())
        (root / "transforms.json").write_text(json.dumps(meta | {"frames": change(meta["frames"])}))

    return made


def inverse(matrix: list[list[float]]) -> list[list[float]]:
    return np.linalg.inv(matrix).tolist()


TRANSFORMS: dict[str, Change] = {
    "frames by number": frames(lambda fs: {str(k): frame for k, frame in enumerate(fs)}),
    "frames by photo": frames(
        lambda fs: {f["file_path"]: {"transform_matrix": f["transform_matrix"]} for f in fs}
    ),
    "other keys": frames(
        lambda fs: [{"image_path": f["file_path"], "c2w": f["transform_matrix"]} for f in fs]
    ),
    "world to camera": frames(
        lambda fs: [{"file_path": f["file_path"], "w2c": inverse(f["transform_matrix"])} for f in fs]
    ),
    "cameras that were scaled with the scene": poses(lambda m: (m @ np.diag([0.3, 0.3, 0.3, 1])).tolist()),
    "sixteen numbers in a list": poses(lambda m: m.ravel().tolist()),
    "column by column": poses(lambda m: m.T.tolist()),
    "sixteen numbers, column by column": poses(lambda m: m.T.ravel().tolist()),
    "UTF-16": utf16,
    "a frame twice": frames(lambda fs: [*fs, fs[2]]),
    "numbers as text": values(w="48", h="36", fl_x=str(FX)),
    "a model in small letters": values(camera_model="pinhole"),
    "a model of another name": values(camera_model="PERSPECTIVE"),
    "no file of points": values(ply_file_path="sparse_pc.ply"),
    "an empty name of points": values(ply_file_path=""),
}


@pytest.mark.parametrize("change", TRANSFORMS.values(), ids=TRANSFORMS)
def test_transforms_are_read_as_they_were_meant(change: Change, tmp_path: Path) -> None:
    write_transforms(TRUTH, tmp_path)
    change(tmp_path)
    same_cameras(load_scene(tmp_path, test_every=0))


def same_cameras(scene: Scene) -> None:
    assert len(scene.train) == len(TRUTH.names)
    for view, viewmat in zip(scene.train, TRUTH.viewmats, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, viewmat, atol=1e-9)
        np.testing.assert_allclose(view.camera.K, TRUTH.K)


def lines(change: Callable[[list[str]], list[str]]) -> Change:
    """The lines of images.txt, two of each photo, changed."""

    def made(root: Path) -> None:
        path = root / "sparse/0/images.txt"
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return made


def marked(root: Path) -> None:
    for path in (root / "sparse/0").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))


def commas(root: Path) -> None:
    for path in (root / "sparse/0").iterdir():
        path.write_text(re.sub(r"(\d)\.(\d)", r"\1,\2", path.read_text()))


MODELS: dict[str, Change] = {
    "decimal commas": commas,
    "no lines of what photos show": lines(lambda text: text[::2]),
    "some without": lines(lambda text: [*text[:4], text[4], *text[6:8], *text[8::2]]),
    "empty lines of what photos show": lines(lambda t: [x for k in t[::2] for x in (k, "")]),
    "byte order marks": marked,
    "no points": lambda root: (root / "sparse/0/points3D.txt").unlink(),
}


@pytest.mark.parametrize("change", MODELS.values(), ids=MODELS)
def test_text_models_are_read_as_they_were_meant(change: Change, tmp_path: Path) -> None:
    write_colmap(TRUTH, tmp_path, binary=False)
    change(tmp_path)
    same_cameras(load_scene(tmp_path, test_every=0))
    assert len(list((tmp_path / "sparse/0").iterdir())) >= 2  # nothing is written there


def test_names_that_are_numbers_are_names(tmp_path: Path) -> None:
    write_colmap(TRUTH, tmp_path, binary=False)
    path = tmp_path / "sparse/0/images.txt"
    path.write_text("\n".join(path.read_text().replace(".png", "").replace("view_", "").splitlines()[::2]))
    for name in TRUTH.names:
        (tmp_path / "images" / name).rename(tmp_path / "images" / name.removeprefix("view_"))
    same_cameras(load_scene(tmp_path, test_every=0))


@pytest.mark.parametrize("binary", [False, True])
def test_points_beside_a_model_without_any(binary: bool, tmp_path: Path) -> None:
    write_colmap(TRUTH, tmp_path, binary=binary)
    next((tmp_path / "sparse/0").glob("points3D.*")).unlink()
    kinds = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.array([(*p, *c) for p, c in zip(TRUTH.points, TRUTH.colors, strict=True)], dtype=kinds)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "sparse/0/points3D.ply"))
    scene = load_scene(tmp_path, test_every=0)
    same_cameras(scene)
    np.testing.assert_allclose(scene.points, TRUTH.points, rtol=1e-6)
    np.testing.assert_array_equal(scene.point_colors, TRUTH.colors)
    assert scene.notes == ["the model has no points; those of points3D.ply beside it are used"]


def none_for(count: int, value: Any) -> Change:
    return frames(
        lambda fs: [*fs[:3], *({**f, "transform_matrix": value} for f in fs[3 : 3 + count]), *fs[3 + count :]]
    )


@pytest.mark.parametrize("value", [None, np.full((4, 4), np.nan).tolist(), np.diag([0, 0, 0, 1]).tolist()])
def test_photos_without_a_pose_are_left_out(value: Any, tmp_path: Path) -> None:
    write_transforms(TRUTH, tmp_path)
    if value is not None:
        value[3] = [0, 0, 0, 1]
    none_for(2, value)(tmp_path)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test] == ["images/view_00.png", "images/view_08.png"]
    assert len(scene.train) == 5
    told = "2 of 9 photos have no pose (nan, 0 or null) and were left out: "
    assert told + "images/view_03.png, images/view_04.png" in scene.notes
    none_for(6, value)(tmp_path)
    with pytest.raises(ValueError, match="6 of 9 photos have no pose: "):
        load_scene(tmp_path)


def test_poses_of_nan_in_a_text_model(tmp_path: Path) -> None:
    write_colmap(TRUTH, tmp_path, binary=False)
    lines(lambda text: [text[0].replace(text[0].split()[5], "nan"), *text[1:]])(tmp_path)
    scene = load_scene(tmp_path, test_every=0)
    assert len(scene.train) == 8
    assert "1 photos of the model have no pose (nan) and were left out: view_08.png" in scene.notes


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (values(cx=0.52, cy=0.48), "are fractions of w, h = 48, 36: multiply fl_x, fl_y, cx and cy by them"),
        (poses(lambda m: np.eye(4).tolist()), "all 9 photos have the same pose, which cannot be right"),
        (
            poses(lambda m: (np.diag([1, 1, -1, 1]) @ m).tolist()),
            "the world is left-handed; negate one of its axes",
        ),
    ],
)
def test_cameras_that_can_be_none_are_refused(change: Change, told: str, tmp_path: Path) -> None:
    write_transforms(TRUTH, tmp_path)
    change(tmp_path)
    with pytest.raises(ValueError, match=told):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (values(fl_x=FX * 100, fl_y=FY * 100, cx=2500, cy=1750), "9 of 9 cameras have their principal point"),
        (poses(lambda m: np.linalg.inv(m).tolist()), "all 9 cameras are at the same place"),
    ],
)
def test_cameras_that_are_odd_are_told(change: Change, told: str, tmp_path: Path) -> None:
    write_transforms(TRUTH, tmp_path)
    change(tmp_path)
    scene = load_scene(tmp_path)
    assert any(note.startswith(told) for note in scene.notes)
    assert scene.world.ordinary


def test_a_link_to_a_photo_that_is_gone(tmp_path: Path) -> None:
    write_transforms(TRUTH, tmp_path)
    path = tmp_path / "images/view_04.png"
    path.unlink()
    path.symlink_to(tmp_path / "gone.png")
    told = "1 of 9 cameras have no photo any more and were left out: images/view_04.png"
    assert told in load_scene(tmp_path).notes


def test_panoramas_with_poses(tmp_path: Path) -> None:
    scene = load_scene(write_transforms(TRUTH, tmp_path, camera_model="equirectangular"), test_every=0)
    assert len(scene.train) == 9 * 6
    front = next(view for view in scene.train if view.name == "images/view_03.front.png")
    np.testing.assert_allclose(front.camera.viewmat, TRUTH.viewmats[3], atol=1e-9)


def frame_of(**own: Any) -> Change:
    """What the first frame says of its camera."""
    return frames(lambda fs: [fs[0] | own, *fs[1:]])


@pytest.mark.parametrize(
    ("change", "focal"),
    [
        (frame_of(camera_angle_x=0.8), (48 / 2 / np.tan(0.4),) * 2),
        (frame_of(camera_angle_x=0.8, fl_y=50), (FX, 50)),
        (frame_of(fl_x=None, camera_model=None, w=None, mask_path=""), (FX, FY)),
        (values(camera_model=None, fl_x=None, fx=FX, cx="25"), (FX, FY)),
    ],
)
def test_what_a_frame_says_wins_and_null_says_nothing(
    change: Change, focal: tuple[float, float], tmp_path: Path
) -> None:
    write_transforms(TRUTH, tmp_path)
    change(tmp_path)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    nothing = dict.fromkeys({"fl_x", "camera_model"} - set(meta))
    (tmp_path / "transforms.json").write_text(json.dumps(meta | nothing))
    view = load_scene(tmp_path, test_every=0).train[0]
    assert (view.camera.K[0, 0], view.camera.K[1, 1]) == pytest.approx(focal)


@pytest.mark.parametrize(("spread", "left"), [(1, 8), (10, 9)])
def test_a_panorama_far_off_is_left_out_as_a_whole(spread: float, left: int, tmp_path: Path) -> None:
    """Where none of its faces shows points of the scene."""
    write_transforms(TRUTH, tmp_path, camera_model="EQUIRECTANGULAR", ply_file_path="points.ply")
    kinds = [(name, "f4") for name in "xyz"]
    rows = np.array([tuple(spread * p) for p in TRUTH.points], dtype=kinds)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "points.ply"))
    meta = json.loads((tmp_path / "transforms.json").read_text())
    meta["frames"][4]["transform_matrix"][0][3] = 150.0
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    scene = load_scene(tmp_path, test_every=0)
    assert len(scene.train) == left * 6
    told = any(note.startswith("6 of 54 cameras are far from all others") for note in scene.notes)
    assert told == (left == 8)
