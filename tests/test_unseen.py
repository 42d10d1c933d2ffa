"""Poses and points whose frames differ are brought together where they decide, said, or refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fixtures_scenes import Truth, make_truth, photographed, write_colmap
from numpy.typing import NDArray
from PIL import Image
from tiny_scene import tiny_config, tiny_scene

import hqgs
from benchmarks.scenes.sparse import sparse_cameras
from hqgs.cli.main import main
from hqgs.evaluation.verdict import fallen
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene, View

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def colored(count: int = 400) -> Truth:
    """Small Gaussians of many colours, with little before each other."""
    truth = make_truth(9)
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.2, 1.2, (count, 3))
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    photos = []
    for viewmat in truth.viewmats:
        photo = np.full((truth.height, truth.width, 3), 128, np.uint8)
        at = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        order = np.argsort(-at[:, 2])  # far ones first
        pixels = at @ truth.K.T
        columns, rows = (pixels[:, :2] / pixels[:, 2:]).astype(int).T
        inside = (columns >= 0) & (columns < truth.width) & (rows >= 0) & (rows < truth.height)
        for k in order[inside[order]]:
            photo[rows[k], columns[k]] = colors[k]
        photos.append(photo)
    return replace(truth, points=points, colors=colors, photos=photos)


def written(truth: Truth, folder: Path) -> Path:
    """A COLMAP model as text, by COLMAP's quaternions: those of half a turn have no w to divide by."""
    root = write_colmap(replace(truth, viewmats=np.stack([np.eye(4)] * 9)), folder, binary=False)
    file = root / "sparse/0/images.txt"
    lines = file.read_text().splitlines()
    for k, line in enumerate(lines):
        parts = line.split(" ")
        if parts[-1] in truth.names:
            viewmat = truth.viewmats[truth.names.index(parts[-1])]
            x, y, z, w = pycolmap.Rotation3d(viewmat[:3, :3]).quat
            lines[k] = " ".join(
                [parts[0], *(repr(float(v)) for v in (w, x, y, z, *viewmat[:3, 3])), *parts[8:]]
            )
    file.write_text("\n".join(lines) + "\n")
    return root


def seen(truth: Truth, viewmats: NDArray[np.float64], points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Pixels [N, P, 2] of points, by their definition."""
    at = np.einsum("nij,pj->npi", viewmats[:, :3, :3], points) + viewmats[:, None, :3, 3]
    return np.asarray((at @ truth.K.T)[..., :2] / at[..., 2:], np.float64)


def check(scene: Scene, truth: Truth) -> None:
    """The points lie where the photos were drawn with them."""
    found = np.stack([view.camera.viewmat for view in scene.train])
    wanted = seen(truth, truth.viewmats, truth.points)
    np.testing.assert_allclose(seen(truth, found, scene.points), wanted, atol=1e-6)


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize(
    ("poses", "said"),
    [
        (lambda V: V, None),
        (lambda V: FLIP @ V, "the file has OpenGL's axes; its format wants OpenCV's"),
        (np.linalg.inv, "poses are read as camera to world"),
        (lambda V: np.linalg.inv(FLIP @ V), "camera to world, though the format has world to camera and the"),
    ],
)
def test_poses_of_another_kind_are_turned(poses, said: str | None, grey: bool, tmp_path: Path) -> None:
    truth = colored()
    colors = np.full_like(truth.colors, 128) if grey else truth.colors
    other = replace(truth, viewmats=poses(truth.viewmats), colors=colors)
    scene = load_scene(written(other, tmp_path), test_every=0)
    check(scene, truth)
    told = [note for note in scene.notes if "as the files have them" in note]
    assert len(told) == (said is not None)
    assert said is None or said in told[0]


def test_plan_judge_and_info_say_what_was_done_with_poses_and_masks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = colored()
    root = written(replace(truth, viewmats=np.linalg.inv(truth.viewmats)), tmp_path / "scene")
    for name in truth.names:
        mask = Image.fromarray(np.full((truth.height, truth.width), 255, np.uint8))
        mask.save(root / "images" / f"{Path(name).stem}_sam_mask.png")
    hqgs.Gaussians.from_points(truth.points, truth.colors, 0).save(tmp_path / "a.ply")
    for command in (["plan", root], ["judge", tmp_path / "a.ply", "--photos", root]):
        assert main([str(part) for part in command]) == 0
        told = " ".join("".join(capsys.readouterr()).split())
        assert told.count("poses are read as camera to world") == 1
        assert told.count("9 of 9 photos have a mask") == 1
    assert main(["info", str(root)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("poses are read as camera to world") == 1
    assert told.count("9 of 9 photos have a mask") == 1
    behind = replace(truth, points=truth.points - np.array([0, 0, 500.0]))
    assert main(["info", str(written(behind, tmp_path / "behind"))]) == 0
    assert "hqgs train refuses it: " in capsys.readouterr().out


@pytest.mark.parametrize(
    "world", [np.eye(3)[[0, 2, 1]] * [1, -1, 1], np.diag([1.0, -1, 1]), np.eye(3)[[1, 0, 2]]]
)
def test_points_of_another_frame_are_turned(world: NDArray[np.float64], tmp_path: Path) -> None:
    truth = colored()
    scene = load_scene(written(replace(truth, points=truth.points @ world.T), tmp_path), test_every=0)
    check(scene, truth)
    assert any("in the frame of the cameras" in note for note in scene.notes)


@pytest.mark.parametrize("unit", [0.001, 0.01, 1000.0])
def test_points_in_another_unit_are_scaled(unit: float, tmp_path: Path) -> None:
    truth = colored()
    scene = load_scene(written(replace(truth, points=truth.points * unit), tmp_path), test_every=0)
    check(scene, truth)
    assert any(f"scaled by {1 / unit:g} to the unit of the cameras" in note for note in scene.notes)


def mixed_up(truth: Truth) -> Truth:
    return replace(truth, viewmats=np.roll(truth.viewmats, 4, 0))


def too_small(truth: Truth) -> Truth:
    return replace(truth, points=truth.points * 0.5)


def too_wide(truth: Truth) -> Truth:
    fx, fy, *center = truth.params
    return replace(truth, params=[fx / 2, fy / 2, *center])


def shifted(truth: Truth) -> Truth:
    return replace(truth, points=truth.points + np.array([0.4, 0.3, 0.0]))


@pytest.mark.parametrize("spoilt", [mixed_up, too_small, too_wide, shifted])
def test_what_cannot_be_mended_is_said(spoilt: Callable[[Truth], Truth], tmp_path: Path) -> None:
    """Photos that have poses of others, a wrong focal length, points of another frame: all in the photos."""
    said = "photos show other colours where the points are"
    assert not any(said in note for note in load_scene(written(colored(), tmp_path / "a")).notes)
    assert any(said in note for note in load_scene(written(spoilt(colored()), tmp_path / "b")).notes)


def test_what_no_photo_shows_is_refused(tmp_path: Path) -> None:
    truth = colored()
    behind = replace(truth, points=truth.points - np.array([0, 0, 500.0]))
    with pytest.raises(
        ValueError, match="no photo shows any of the 400 points, which lie behind all cameras"
    ):
        load_scene(written(behind, tmp_path / "a"))
    aside = replace(truth, points=truth.points + np.array([5000.0, 0, 0]))
    with pytest.raises(
        ValueError, match=r"outside of all photos: do they belong to another scene, frame or unit\?"
    ):
        load_scene(written(aside, tmp_path / "b"))
    away = np.where(np.arange(400) < 300, 5000.0, 0)[:, None]
    scene = load_scene(written(replace(truth, points=truth.points + away), tmp_path / "c"))
    (share,) = [note for note in scene.notes if "of the points are in no photo" in note]
    assert share.startswith("7")  # 75 of 100, and those of the others that lie beside all pictures


def test_a_scene_made_in_python_is_asked_too() -> None:
    camera = sparse_cameras(48, 36, 9)[0]
    view = View("a", camera, np.zeros((36, 48, 3), np.uint8))
    behind = camera.center - 100 * camera.viewmat[2, :3] + np.random.default_rng(0).normal(size=(9, 3))
    scene = Scene("s", [view], [], behind, np.zeros((9, 3), np.uint8), "colmap")
    with pytest.raises(ValueError, match="no photo shows any of the 9 points"):
        hqgs.train(scene, iterations=2)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points_are_too_few_to_start_from(count: int, tmp_path: Path) -> None:
    truth, _ = photographed(make_truth(9))
    few = replace(truth, points=truth.points[:count], colors=truth.colors[:count])
    scene = hqgs.load(write_colmap(few, tmp_path))
    run = hqgs.train(scene, iterations=20, method="3dgs")
    assert run.finished
    assert len(run.model) > 1000
    assert any("random points" in note for note in run.report["notes"])


def test_a_run_that_ends_below_one_flat_colour_says_so(tmp_path: Path) -> None:
    truth, _ = photographed(make_truth(9))
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.01, 0.01, (2, 3)), rng.normal(5000.0, 1, (200, 3))])
    light = [np.maximum(photo, 150) for photo in truth.photos]
    there = replace(truth, photos=light, points=points, colors=np.zeros((202, 3), np.uint8))
    run = hqgs.train(load_scene(write_colmap(there, tmp_path)), iterations=30, method="3dgs")
    assert "have a larger error than a picture of one colour" in run.report["notes"][0]
    assert run.report.get("fallen") == run.report["notes"][0]
    sound = hqgs.load("embedded", downscale=12)
    assert "fallen" not in hqgs.train(sound, iterations=40, method="3dgs").report


def test_a_held_out_photo_that_its_mask_hides_says_nothing_of_the_run() -> None:
    scene = tiny_scene()
    (view,) = scene.test
    hidden = replace(view, mask=np.zeros(view.image.shape[:2], bool))
    run = hqgs.train(replace(scene, test=[hidden]), config=tiny_config(30))
    assert run.finished
    assert "fallen" not in run.report


def test_a_run_that_ends_below_its_first_step_says_so() -> None:
    told = fallen(9.0, 8.5, 14.0)
    assert told is not None
    assert told.startswith("the last step is worse than the first one (9.0 dB, 14.0 dB)")
    assert fallen(13.5, 8.5, 14.0) is None
    assert fallen(None, 8.5, 14.0) is None
