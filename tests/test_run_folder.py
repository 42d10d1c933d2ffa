"""What a run was, as its folder tells it: photos, split, background; measured with these, or not at all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures_scenes import make_truth, photographed, write_photos, write_transforms
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.cli.main import main
from hqgs.cli.view import ViewOptions
from hqgs.cli.view import run as view
from hqgs.evaluation.records import read_report
from hqgs.evaluation.run_folder import RunFolder, check_same, moved_px
from hqgs.scene import load as loading
from hqgs.scene import source as scene_source
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.photos_alone import Search
from hqgs.scene.source import finding, pictures
from hqgs.scene.world import World
from hqgs.training.prepare import facts_of


def with_poses(scene: Scene, move: np.ndarray) -> Scene:
    """All cameras moved by a world-to-world matrix [4, 4], its points left where they are."""
    views = [
        [replace(v, camera=replace(v.camera, viewmat=v.camera.viewmat @ move)) for v in part]
        for part in (scene.train, scene.test)
    ]
    return replace(scene, train=views[0], test=views[1])


def test_photos_that_are_gone_new_or_held_out_otherwise_are_named(tmp_path: Path) -> None:
    scene = tiny_scene()
    check_same(scene, RunFolder(tmp_path), split=True)  # a run without cameras.json
    save_cameras(tmp_path, scene)
    check_same(scene, RunFolder(tmp_path), split=True)
    fewer = replace(scene, train=scene.train[1:])
    other = replace(scene, train=[replace(scene.train[0], name="x.png"), *scene.train[1:]])
    swapped = replace(scene, train=[*scene.test, *scene.train[1:]], test=scene.train[:1])
    gone = scene.train[0].name
    for changed, told in (
        (fewer, f"(gone: {gone})"),
        (other, f"(gone: {gone}; new: x.png)"),
        (swapped, "(others are held out)"),
    ):
        with pytest.raises(ValueError, match="the photos differ from those of the run") as error:
            check_same(changed, RunFolder(tmp_path), split=True)
        assert told in str(error.value)
        check_same(
            changed, RunFolder(tmp_path), split=False
        )  # the user names photos, and their cameras are the run's
    none = replace(scene, test=[], train=[replace(view, name=f"x{view.name}") for view in scene.train])
    with pytest.raises(ValueError, match="no photo is in both"):
        check_same(none, RunFolder(tmp_path), split=False)


def test_cameras_of_another_frame_are_refused_by_what_they_move(tmp_path: Path) -> None:
    scene = tiny_scene()
    save_cameras(tmp_path, scene)
    known = load_cameras(tmp_path)
    assert moved_px(scene, known) == pytest.approx(0, abs=1e-9)
    little, much = np.eye(4), np.eye(4)
    little[0, 3] = 1e-4
    much[:3, :3] = Rotation.from_rotvec([0, 0.2, 0]).as_matrix()
    assert moved_px(with_poses(scene, little), known) == pytest.approx(0, abs=0.1)
    check_same(with_poses(scene, little), RunFolder(tmp_path), split=True)
    turned = with_poses(scene, much)
    camera = scene.train[0].camera
    off = moved_px(turned, known)
    assert off is not None
    assert off > 0.1 * camera.K[0, 0]
    for split in (False, True):
        with pytest.raises(
            ValueError, match=rf"points move by {off:.1f} px in the photos. The photos have changed since"
        ):
            check_same(turned, RunFolder(tmp_path), split=split)


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
    save_cameras(tmp_path, lying)
    check_same(lying, RunFolder(tmp_path), split=True)


def test_cameras_are_found_as_for_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert finding({}, tmp_path) == {"coarse": False}  # as without a run
    folder = tmp_path / "photos"
    write_photos(make_truth(4), folder)

    def origin(**values: Any) -> dict[str, Any]:
        (tmp_path / "config.json").write_text(json.dumps({"scene": values}))
        return finding(RunFolder(tmp_path).loaded, folder)

    assert origin(longest=480, features="learned", frames=9) == {"coarse": True}
    assert origin(longest=1600) == {"coarse": False}
    assert origin(longest=None, coarse=True) == {"coarse": True}
    (tmp_path / "film.mp4").write_bytes(b"")
    assert finding(RunFolder(tmp_path).loaded, tmp_path / "film.mp4") == {"coarse": True, "frames": None}

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
    trained: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos, run = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(trained[0], photos)
    shutil.copytree(trained[1], run)
    config = json.loads((run / "config.json").read_text())
    config["scene"]["path"] = str(photos)
    (run / "config.json").write_text(json.dumps(config))
    path = photos / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"frames": content["frames"][1:]}))
    capsys.readouterr()
    for command in (["judge", str(run)], ["clean", str(run), "--out", str(tmp_path / "a.ply")]):
        assert main(command) == 2
        assert "the photos differ from those of the run" in capsys.readouterr().err


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Photos, of which one is black, and a run of them, before white, which holds every fifth out."""
    root = tmp_path_factory.mktemp("trained")
    truth, _ = photographed(make_truth(12))
    truth.photos[6][:] = 0
    photos = write_transforms(truth, root / "scene")
    config = tiny_config(2, leave_out=("photos",), background=(1.0, 1.0, 1.0))
    hqgs.train(hqgs.load(photos, test_every=5), out=root / "run", config=config)
    return photos, root / "run"


def judged(tmp_path: Path, *arguments: object) -> dict[str, Any]:
    out = tmp_path / "judged"
    assert main(["judge", *map(str, arguments), "--out", str(out)]) == 0
    return json.loads((out / "judge.json").read_text())


def test_a_run_that_left_a_photo_out_is_measured_without_it(
    trained: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos, run = trained
    (black,) = RunFolder(run).without
    assert "06" in black
    names = judged(tmp_path, run, "--views", "train")["protocol"]["names"]
    assert black not in names
    assert len(names) == 8
    assert judged(tmp_path, run)["scene"]["mean"] == read_report(run / "report.json")["metrics"]["mean"]
    main(["clean", str(run), "--out", str(tmp_path / "a.ply"), "--steps", "5"])
    assert "the photos differ from those" not in capsys.readouterr().err
    # Its split and its background hold for photos that are named, too, and for each file in its folder.
    for source in (run, run / "scene.ply"):
        found = judged(tmp_path, source, "--photos", photos)
        assert found["protocol"]["names"] == judged(tmp_path, run)["protocol"]["names"]
    said = capsys.readouterr().err
    assert "--test-every holds out photos that the run was trained on" not in said
    judged(tmp_path, run, "--photos", photos, "--test-every", "4")
    said = capsys.readouterr().err
    assert "--test-every holds out photos that the run was trained on: images/view_04" in said


def test_each_file_of_a_run_is_shown_before_its_background(
    trained: tuple[Path, Path], tmp_path: Path
) -> None:
    photos, run = trained[0], tmp_path / "run"
    shutil.copytree(trained[1], run)
    assert main(["export", str(run), "--out", str(run / "small.spz")]) == 0
    for source in (run, run / "scene.ply", run / "small.spz"):
        assert RunFolder.open(source).background == (1.0, 1.0, 1.0)
        found = judged(tmp_path, source, "--photos", photos)
        assert found["protocol"]["background"] == [1.0, 1.0, 1.0]
    (tmp_path / "away").mkdir()
    hqgs.Gaussians.load(run).save(tmp_path / "away" / "scene.ply")
    shown = {}
    for name, options in (("own", []), ("black", ["--background", "0", "0", "0"])):
        assert main(["render", str(run), "--views", "test", "--out", str(tmp_path / name), *options]) == 0
        shown[name] = [np.array(Image.open(file)) for file in sorted((tmp_path / name).iterdir())]
    away = ["render", str(tmp_path / "away" / "scene.ply"), "--path", "orbit", "--frames", "1"]
    assert main([*away, "--out", str(tmp_path / "a.png")]) == 0
    assert any((a != b).any() for a, b in zip(shown["own"], shown["black"], strict=True))
    (run / "config.json").unlink()  # cameras.json tells it too
    assert RunFolder.open(run / "small.spz").background == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("name", ["cameras.json", "report.json", "config.json"])
@pytest.mark.parametrize("content", ['[{"id": 0, "img_name": "a"}]', '{"camera_model": "OPENCV"}'])
def test_files_of_other_programs_beside_a_scene_are_passed_by(
    tmp_path: Path, name: str, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    photographed(make_truth(4))[1].save(tmp_path / "point_cloud.ply")
    (tmp_path / name).write_text(content)
    file, out = str(tmp_path / "point_cloud.ply"), str(tmp_path / "a.png")
    assert main(["render", file, "--out", out]) == 0
    assert main(["export", file, "--out", str(tmp_path / "b.spz")]) == 0
    assert main(["info", file]) == 0
    monkeypatched = ViewOptions(source=tmp_path / "point_cloud.ply", port=0)
    assert view(monkeypatched, seconds=0.01) == 0
    assert "Error" not in capsys.readouterr().err


def test_what_an_older_run_wrote_is_gone_after_overwrite(tmp_path: Path) -> None:
    scene = tiny_scene(9)
    lit = [replace(view, mask=np.ones(view.image.shape[:2], bool)) for view in scene.train]
    hqgs.train(replace(scene, train=lit), out=tmp_path, config=tiny_config(2))
    (tmp_path / "sfm").mkdir()
    small = replace(scene, train=scene.train[:3], test=scene.train[3:4])
    hqgs.train(small, out=tmp_path, config=tiny_config(2), overwrite=True)
    assert sorted(path.name for path in (tmp_path / "photos").iterdir()) == [f"0000{k}.jpg" for k in range(4)]
    assert [path.name for path in (tmp_path / "comparison").iterdir()] == ["view4.png"]
    assert (tmp_path / "sfm").is_dir()


def test_a_plan_is_of_all_photos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Photos alone, of which few are looked at: as many as are trained on."""
    (tmp_path / "photos").mkdir()
    for k in range(40):
        noise = np.random.default_rng(k).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / f"{k:02}.png")
    scene = pictures(tmp_path / "photos", test_every=8)
    assert (scene.of, len(scene.train)) == (35, 16)
    assert not {view.name for view in scene.train} & {f"{k:02}.png" for k in range(0, 40, 8)}
    facts = facts_of(scene)
    assert (facts.photos, facts.pixels) == (35, 35 * 24 * 32)
    assert main(["plan", str(tmp_path / "photos")]) == 0
    told = capsys.readouterr().out
    assert "photos: 35 photos to train on (16 of them measured), 0 points" in told
    assert "diagnosis of 19 of 35 photos" in str(hqgs.diagnose(scene))
    assert pictures(tmp_path / "photos").of == 40


def test_a_plan_beside_a_run_holds_out_as_that_does(
    trained: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    photos, run = map(str, trained)
    for said, count in ((["--out", run], 9), (["--out", run, "--test-every", "8"], 10), ([], 10)):
        assert main(["plan", photos, "--method", "3dgs", *said]) == 0
        assert f"{count} photos to train on" in capsys.readouterr().out


def test_a_folder_that_is_called_as_a_built_in_scene_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of the built-in scene stays one beside such a folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(scene_source, "embedded_scene", lambda *_: tiny_scene())
    hqgs.train(hqgs.load("embedded"), out="run", config=tiny_config())
    write_transforms(make_truth(4), tmp_path / "embedded")
    for path in ("embedded", "./embedded", Path("embedded"), tmp_path / "embedded"):
        scene = hqgs.load(path)
        assert scene.source == "transforms"
        assert any("not the built-in scene of that name" in note for note in scene.notes) == (
            str(path) == "embedded"
        )
    assert main(["judge", "run"]) == 0
    assert main(["info", "embedded"]) == 0


def test_a_built_in_scene_that_is_gone_is_told(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"scene": {"path": "sparse"}}')
    with pytest.raises(ValueError, match="there is no built-in scene 'sparse'"):
        RunFolder(tmp_path).photos()


@pytest.mark.parametrize("option", [["--frames", "0"], ["--frames", "5"], ["--up", "0", "0", "0"]])
def test_options_of_a_path_are_refused_with_views(
    tmp_path: Path, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = tiny_scene()
    hqgs.Gaussians.from_points(tiny.points, tiny.point_colors).save(tmp_path / "scene.ply")
    save_cameras(tmp_path, tiny)
    command = ["render", str(tmp_path), "--views", "test", "--out", str(tmp_path / "a"), *option]
    assert main(command) == 2
    assert f"{option[0]} is for paths, and --views uses the photos' cameras" in capsys.readouterr().err


def test_a_run_of_before_has_learned_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hqgs.train(tiny_scene(), out=tmp_path, config=tiny_config(2))
    report = json.loads((tmp_path / "report.json").read_text())
    for name in ("learned", "left_out", "plan", "photos"):
        report.pop(name)
    (tmp_path / "report.json").write_text(json.dumps(report))
    command = ["render", str(tmp_path), "--out", str(tmp_path / "a.png")]
    assert main([*command, "--look", "view1"]) == 2
    assert "was learned" in capsys.readouterr().err
    assert main(["info", str(tmp_path)]) == 0
    assert view(ViewOptions(source=tmp_path, port=0), seconds=0.01) == 0
