"""One world for all units: a scene is the same in millimetres, in a survey's frame, with a camera far off."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures_scenes import Truth, make_truth, photographed, write_colmap, write_transforms
from planned import run_config
from plyfile import PlyData
from scipy.spatial.transform import Rotation

import hqgs
from hqgs.cli.main import main
from hqgs.evaluation.held_out import held_out_renders
from hqgs.model.gaussians import Gaussians
from hqgs.photos.formula import parse_degradation
from hqgs.pipeline import open_run, run_to_end
from hqgs.scene.camera_files import load_cameras, load_path, moved, save_cameras, save_path
from hqgs.scene.degrade import write_degraded_scene
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.scene.world import World
from hqgs.training.frame import Frame

UTM = np.array([500000.0, 5200000.0, 300.0])


def placed(truth: Truth, scale: float, shift: np.ndarray, seed: int | None = None) -> Truth:
    """The scene x -> scale R x + shift, R at random (the unit without a seed)."""
    R = np.eye(3) if seed is None else Rotation.random(None, np.random.default_rng(seed)).as_matrix()
    viewmats = truth.viewmats.copy()
    for viewmat in viewmats:
        viewmat[:3, :3] = viewmat[:3, :3] @ R.T
        viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3] @ shift
    return replace(truth, viewmats=viewmats, points=scale * truth.points @ R.T + shift)


def pictures(scene: Scene, gaussians: Gaussians | None = None) -> torch.Tensor:
    model = Gaussians.from_points(scene.points, scene.point_colors) if gaussians is None else gaussians
    with torch.no_grad():
        return torch.stack([model.render(view.camera) for view in scene.train])


def kept(scale: float, away: float) -> float:
    """2e-5, and what the float64 of the files themselves loses of a small scene that far away."""
    return 2e-5 + 2e-14 * away / scale


def same(shown: torch.Tensor, wanted: torch.Tensor, most: float) -> bool:
    """Alike but for pixels where a Gaussian ends, which jump by up to the floor of alpha, 1/255."""
    off = (shown - wanted).abs()
    return bool((off > most).double().mean() < 1e-3 and off.max() < 1 / 255)


def load(truth: Truth, root: Path) -> Scene:
    return load_scene(write_colmap(truth, root, binary=False), test_every=0)


def test_an_ordinary_scene_keeps_every_bit(tmp_path: Path) -> None:
    truth = make_truth()
    scene = load(truth, tmp_path)
    assert scene.world.ordinary
    for view, viewmat in zip(scene.train, truth.viewmats, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, viewmat, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(scene.points, truth.points)


def test_pictures_are_the_same_in_any_unit_and_place(tmp_path: Path) -> None:
    truth = make_truth(4)
    wanted = pictures(load(truth, tmp_path / "own"))
    assert wanted.max() > 0.05
    rng = np.random.default_rng(0)
    drawn = [(10 ** rng.uniform(-3, 3), rng.normal(size=3) * 10 ** rng.uniform(0, 6.7)) for _ in range(30)]
    ends = [(1e-3, 0.0), (1e3, 0.0), (1.0, 5e6), (1e-3, 5e6), (1e3, 5e6)]
    for k, (scale, shift) in enumerate([*((scale, np.full(3, away)) for scale, away in ends), *drawn]):
        scene = load(placed(truth, scale, shift, seed=k), tmp_path / str(k))
        assert same(pictures(scene), wanted, kept(scale, float(np.abs(shift).max()))), (scale, shift)
        told = any("written in the frame of the input" in note for note in scene.notes)
        assert told or k >= len(ends)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("away", [1e2, 1e4, 1e6])
def test_a_camera_far_off_is_left_out_and_named(tmp_path: Path, axis: int, away: float) -> None:
    truth = make_truth()
    viewmats = truth.viewmats.copy()
    viewmats[4][axis, 3] += away
    scene = load(replace(truth, viewmats=viewmats), tmp_path)
    names = [name for name in truth.names if name != "view_04.png"]
    assert [view.name for view in scene.train] == names
    assert any("1 of 9 cameras are far" in note and "view_04.png" in note for note in scene.notes)
    own = load(truth, tmp_path / "own")
    assert scene.extent == pytest.approx(own.extent, rel=0.1)
    assert scene.reach == pytest.approx(own.reach, rel=0.1)
    assert scene.world.ordinary


def test_a_far_camera_that_shows_the_scene_stays_and_moves_no_size(tmp_path: Path) -> None:
    """Forty times as far away with a lens of forty times the length: a telephoto picture."""
    truth = make_truth()
    own = load(truth, tmp_path / "own")
    views = list(own.train)
    viewmat = views[4].camera.viewmat.copy()
    viewmat[2, 3] *= 40
    views[4] = replace(views[4], camera=replace(views[4].camera, viewmat=viewmat))
    assert replace(own, train=views).extent == pytest.approx(own.extent, rel=0.1)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_what_is_written_is_in_the_frame_of_the_files(
    tmp_path: Path, scale: float, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = placed(make_truth(), scale, UTM)
    scene = load(truth, tmp_path / "scene")
    model = Gaussians.from_points(scene.points, scene.point_colors, 0)
    model.world = scene.world
    wanted = pictures(scene, model)
    for name in ("a.ply", "a.glb", "a.spz", "a.splat", "a.compressed.ply", "a.full.ply"):
        path = tmp_path / name
        model.save(path)
        read = Gaussians.load(path)
        out = read.world.out(read.means.double().numpy())
        exact = name in ("a.ply", "a.glb", "a.full.ply")
        if exact:
            np.testing.assert_allclose(out, truth.points, atol=scale * 1e-5 + 1e-9)
        assert (pictures(scene, read) - wanted).abs().max() < (2e-5 if exact else 0.1)
        assert (tmp_path / f"{name}.world.json").exists() == (name not in ("a.ply", "a.glb"))
    assert main(["info", str(tmp_path / "a.spz")]) == 0
    told = re.search(r"lie within x, y, z: \S+ to \S+, (\S+) to ", capsys.readouterr().out)
    assert told is not None
    assert float(told[1]) == pytest.approx(UTM[1], rel=0.01)
    vertices = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert vertices["x"].dtype == np.float64
    np.testing.assert_allclose(vertices["y"], truth.points[:, 1], rtol=1e-12)
    beside = json.loads((tmp_path / "a.spz.world.json").read_text())
    np.testing.assert_allclose(beside["shift"], UTM, atol=10)


def test_cameras_and_paths_are_written_in_the_frame_of_the_files(tmp_path: Path) -> None:
    truth = placed(make_truth(), 1e-3, UTM)
    scene = load(truth, tmp_path / "scene")
    save_cameras(tmp_path / "run", scene)
    stored = json.loads((tmp_path / "run/cameras.json").read_text())["views"]
    for entry, viewmat in zip(stored, truth.viewmats, strict=True):
        np.testing.assert_allclose(entry["world_to_camera"], viewmat, rtol=1e-9, atol=1e-6)
    for known, view in zip(load_cameras(tmp_path / "run").views, scene.train, strict=True):
        np.testing.assert_allclose(known.camera.viewmat, view.camera.viewmat, atol=1e-5)
    cameras = [view.camera for view in scene.train]
    save_path(tmp_path / "path.json", cameras, world=scene.world)
    read, _ = load_path(tmp_path / "path.json")
    np.testing.assert_allclose(
        read[0].center, -truth.viewmats[0, :3, :3].T @ truth.viewmats[0, :3, 3], rtol=1e-9
    )
    np.testing.assert_allclose(moved(read[0], scene.world).viewmat, cameras[0].viewmat, atol=1e-5)
    write_degraded_scene(scene, tmp_path / "worse", parse_degradation("none"), 0)
    again = load_scene(tmp_path / "worse", test_every=0)
    np.testing.assert_allclose(again.train[0].camera.viewmat, cameras[0].viewmat, atol=1e-5)


def test_a_foreign_scene_of_small_units_is_seen(tmp_path: Path) -> None:
    """Its Gaussians keep their numbers; what is too near to be shown goes by their size."""
    scene = load(make_truth(), tmp_path)
    model = Gaussians.from_points(scene.points, scene.point_colors, 0)
    wanted = pictures(scene, model)
    small = model.like(model.named() | {"means": model.means * 1e-3, "scales": model.scales + np.log(1e-3)})
    for view, picture in zip(scene.train, wanted, strict=True):
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] *= 1e-3
        with torch.no_grad():
            seen = small.render(replace(view.camera, viewmat=viewmat))
        assert (seen - picture).abs().max() <= 2e-5


def test_a_file_in_the_frame_of_the_cameras_is_measured_in_it(tmp_path: Path) -> None:
    """A scene file that says nothing of a frame, float32, beside cameras in small units."""
    truth = placed(make_truth(), 1e-3, np.zeros(3))
    scene = load_scene(write_colmap(truth, tmp_path, binary=False))
    model = Gaussians.from_points(scene.points, scene.point_colors, 0)
    model.world = scene.world
    foreign = model.in_world(World())
    np.testing.assert_allclose(foreign.means, truth.points, rtol=1e-5)
    own, other = (held_out_renders(scene, g)[0].render for g in (model, foreign))
    assert own.max() > 0.05
    np.testing.assert_allclose(other, own, atol=1e-4)


def test_cameras_are_fitted_in_the_frame_of_the_photos(tmp_path: Path) -> None:
    """The photos are renders of cameras that stand a little beside those of the files."""
    own, model = photographed(make_truth(), beside=0.08)
    truth = placed(own, 1e-3, np.zeros(3))
    root = write_colmap(truth, tmp_path / "scene", binary=False)
    small = {"means": model.means * 1e-3, "scales": model.scales + np.log(1e-3)}
    replace(model, **small).save(tmp_path / "foreign.ply")
    options = [str(tmp_path / "foreign.ply"), "--photos", str(root), "--fit-cameras", "--out", str(tmp_path)]
    assert main(["judge", *options]) == 0
    found = json.loads((tmp_path / "judge.json").read_text())["scene"]
    assert found["fitted"]["mean"]["psnr"] > found["mean"]["psnr"] + 3


def moves(count: int, seed: int) -> list[tuple[float, np.ndarray, int]]:
    """Similarities at random: scales of 1e-3 to 1e3, a million sizes away at most."""
    rng = np.random.default_rng(seed)
    scales, aways = 10 ** rng.uniform(-3, 3, count), 10 ** rng.uniform(0, 6, count)
    ways = rng.normal(size=(count, 3))
    shifts = (scales * aways / np.linalg.norm(ways, axis=1))[:, None] * ways
    return [(float(scales[k]), shifts[k], k) for k in range(count)]


@pytest.mark.parametrize("strayed", [False, True], ids=["whole", "a camera far off"])
def test_a_run_has_the_same_bits_in_any_frame(strayed: bool, tmp_path: Path) -> None:
    """All that is decided and trained; what comes out of it is in each frame, and looks the same."""
    truth, found = make_truth(), []
    if strayed:
        truth.viewmats[4][0, 3] += 1e4
    for k, (scale, shift, seed) in enumerate([(1.0, np.zeros(3), None), *moves(3, int(strayed))]):
        root = write_colmap(placed(truth, scale, shift, seed), tmp_path / str(k), binary=False)
        scene = hqgs.load(root, test_every=0)
        with open_run(scene, run_config(iterations=60, method="3dgs"), tmp_path / f"run{k}") as trainer:
            run = run_to_end(trainer)
        decided = [(row["what"], row["value"]) for row in run.report["plan"]]
        counts = [entry.get("gaussians", 0) for entry in run.history]
        found.append((decided, counts, trainer.gaussians.named(), pictures(scene, run.model)))
        assert run.model.world == scene.world
        assert len(run.model) > len(scene.points)
    for decided, counts, tensors, shown in found[1:]:
        assert (decided, counts) == found[0][:2]
        for name, tensor in tensors.items():
            assert torch.equal(tensor, found[0][2][name]), name
        assert same(shown, found[0][3], 2e-5)


def test_what_is_left_of_a_scene_has_the_cameras_that_were_given(tmp_path: Path) -> None:
    scene = load(placed(make_truth(), 3.0, UTM, 1), tmp_path)
    given = replace(scene, test=[replace(view, name="a") for view in scene.train[:3]])
    frame = Frame.of(given)
    trained = frame.scene()
    left = frame.outward(replace(trained, train=trained.train[2:7:2]))
    assert [view.camera for view in left.train] == [view.camera for view in given.train[2:7:2]]
    assert [view.camera for view in left.test] == [view.camera for view in given.test]
    assert (left.points is given.points, left.world) == (True, given.world)


def test_a_walk_away_from_most_photos_is_no_mistake(tmp_path: Path) -> None:
    """Without points nothing tells that a camera far off is wrong."""
    truth = make_truth(9)
    viewmats = truth.viewmats.copy()
    viewmats[7:, 2, 3] += 600.0  # of nine cameras four units from the origin
    write_transforms(replace(truth, viewmats=viewmats), tmp_path)
    scene = hqgs.load(tmp_path, test_every=0)
    assert len(scene.train) == 9
    assert not any("are far from" in note for note in scene.notes)
    assert scene.extent < 20
