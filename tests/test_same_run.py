"""A run is measured with the photos and the cameras that it was trained with, or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_scenes import make_truth, photographed, write_photos, write_transforms
from scipy.spatial.transform import Rotation
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.cli.main import main
from hqgs.cli.scenes import config_part
from hqgs.scene import load as loading
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.same_run import check_same, moved_px
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.photos_alone import Search
from hqgs.scene.source import finding
from hqgs.scene.world import World


def with_poses(scene: Scene, move: np.ndarray) -> Scene:
    """All cameras moved by a world-to-world matrix [4, 4], its points left where they are."""
    views = [
        [replace(v, camera=replace(v.camera, viewmat=v.camera.viewmat @ move)) for v in part]
        for part in (scene.train, scene.test)
    ]
    return replace(scene, train=views[0], test=views[1])


def test_photos_that_are_gone_new_or_held_out_otherwise_are_named(tmp_path: Path) -> None:
    scene = tiny_scene()
    check_same(scene, tmp_path, split=True)  # a run without cameras.json
    save_cameras(tmp_path, scene)
    check_same(scene, tmp_path, split=True)
    fewer = replace(scene, train=scene.train[1:])
    other = replace(scene, train=[replace(scene.train[0], name="x.png"), *scene.train[1:]])
    swapped = replace(scene, train=[*scene.test, *scene.train[1:]], test=scene.train[:1])
    gone = scene.train[0].name
    for changed, told in (
        (fewer, f"(gone: {gone})"),
        (other, f"(gone: {gone}; new: x.png)"),
        (swapped, "(others are held out)"),
    ):
        with pytest.raises(ValueError, match="these are not the photos that the run") as error:
            check_same(changed, tmp_path, split=True)
        assert told in str(error.value)
        check_same(changed, tmp_path, split=False)  # the user names photos, and their cameras are the run's
    none = replace(scene, test=[], train=[replace(view, name=f"x{view.name}") for view in scene.train])
    with pytest.raises(ValueError, match="none is one of the run's"):
        check_same(none, tmp_path, split=False)


def test_cameras_of_another_frame_are_refused_by_what_they_move(tmp_path: Path) -> None:
    scene = tiny_scene()
    save_cameras(tmp_path, scene)
    known = load_cameras(tmp_path)
    assert moved_px(scene, known) == pytest.approx(0, abs=1e-9)
    little, much = np.eye(4), np.eye(4)
    little[0, 3] = 1e-4
    much[:3, :3] = Rotation.from_rotvec([0, 0.2, 0]).as_matrix()
    assert moved_px(with_poses(scene, little), known) == pytest.approx(0, abs=0.1)
    check_same(with_poses(scene, little), tmp_path, split=True)
    turned = with_poses(scene, much)
    camera = scene.train[0].camera
    off = moved_px(turned, known)
    assert off is not None
    assert off > 0.1 * camera.K[0, 0]
    for split in (False, True):
        with pytest.raises(
            ValueError, match=rf"photos are off by {off:.1f} px. The photos have changed since"
        ):
            check_same(turned, tmp_path, split=split)


def seen_from(scene: Scene, world: World, viewmat: Callable[[np.ndarray], np.ndarray]) -> Scene:
    """The same cameras, in another frame."""
    train, test = (
        [replace(v, camera=replace(v.camera, viewmat=viewmat(v.camera.viewmat))) for v in part]
        for part in (scene.train, scene.test)
    )
    return replace(scene, train=train, test=test, world=world)


def test_the_frame_in_which_a_scene_is_held_does_not_count(tmp_path: Path) -> None:
    scene = tiny_scene()
    far = World(unit=4.0, shift=(100.0, -20.0, 3.0))
    save_cameras(tmp_path, scene)
    assert moved_px(seen_from(scene, far, far.viewmat_into), load_cameras(tmp_path)) == pytest.approx(
        0, abs=1e-6
    )
    metres = World(unit=0.5, shift=(50.0, -10.0, 1.5), metres=0.5)
    save_cameras(tmp_path, replace(scene, world=metres))

    def in_units(viewmat: np.ndarray) -> np.ndarray:  # of the files, of which two are a metre
        out = metres.viewmat_out(viewmat).copy()
        out[:3, 3] *= 2
        return out

    assert moved_px(seen_from(scene, World(), in_units), load_cameras(tmp_path)) == pytest.approx(0, abs=1e-6)


def test_photos_on_their_side_are_the_same_ones(tmp_path: Path) -> None:
    scene = tiny_scene()
    lying = replace(scene, train=[replace(view, quarter_turns=1) for view in scene.train])
    save_cameras(tmp_path / "now", lying)
    save_cameras(tmp_path / "old", scene)  # as older versions wrote them
    for run in ("now", "old"):
        check_same(lying, tmp_path / run, split=True)


def test_cameras_are_found_as_for_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert finding({}, tmp_path) == {"coarse": False}  # as without a run
    folder = tmp_path / "photos"
    write_photos(make_truth(4), folder)

    def origin(**values: Any) -> dict[str, Any]:
        (tmp_path / "config.json").write_text(json.dumps({"scene": values}))
        return finding(config_part(tmp_path, "scene"), folder)

    assert origin(longest=480, frames=9) == {"coarse": True}
    assert origin(longest=1600) == {"coarse": False}
    assert origin(longest=None, coarse=True) == {"coarse": True}
    (tmp_path / "film.mp4").write_bytes(b"")
    assert finding(config_part(tmp_path, "scene"), tmp_path / "film.mp4") == {"coarse": True, "frames": None}

    asked = list[Search]()

    def heard(root: object, photos: object, search: Search) -> None:
        asked.append(search)
        raise InterruptedError

    monkeypatch.setattr(loading, "read_photos", heard)
    for longest, coarse in ((480, None), (1600, None), (1600, True), (480, False)):
        with pytest.raises(InterruptedError):
            hqgs.load(folder, longest=longest, coarse=coarse)
    assert [search.coarse for search in asked] == [True, False, True, False]


def test_a_run_whose_photos_changed_is_not_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, _ = photographed(make_truth(9))
    photos, run = write_transforms(truth, tmp_path / "scene"), tmp_path / "run"
    hqgs.train(hqgs.load(photos), out=run, config=tiny_config())
    assert main(["judge", str(run)]) == 0
    path = photos / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"frames": content["frames"][1:]}))
    capsys.readouterr()
    for command in (["judge", str(run)], ["clean", str(run), "--out", str(tmp_path / "a.ply")]):
        assert main(command) == 2
        assert "these are not the photos that the run" in capsys.readouterr().err
