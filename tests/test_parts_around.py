"""Parts that start from the coarse whole: with what, beside which photos, how bright; and polishing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import tiny_config, tiny_scene

import hqgs
from benchmarks.parts import photo_name, write_city
from hqgs.model.gaussians import Gaussians
from hqgs.scene import split as splitting
from hqgs.scene.camera_files import save_cameras
from hqgs.scene.cells import Cut, cell_of
from hqgs.scene.formats.part_json import Part, read_part
from hqgs.scene.geometry import in_picture, project
from hqgs.scene.scene import Scene
from hqgs.scene.split import Split, split
from hqgs.training.config import HQGSConfig
from hqgs.training.methods.cameras import LearnedCameras
from hqgs.training.methods.hqgs import HQGS
from hqgs.training.methods.shared_gains import beside
from hqgs.training.polish import polished
from hqgs.training.schedule import GUEST_EVERY, Schedule
from hqgs.training.trainer import Trainer
from hqgs.training.veils import veils

PHOTOS, POINTS = 36, 1440
HALVES = Cut((1.0, 0.0, 0.0), 0.25, 0, 1)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Split:
    root = tmp_path_factory.mktemp("around")
    write_city(root / "city", PHOTOS, POINTS)
    return split(root / "city", root / "parts", 4)


def coarse_file(folder: Path, seed: int = 7, sh_degree: int = 1) -> Path:
    """Gaussians before and beside the photos of the tiny scene, and some behind its cameras."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-9, -2, -3], [9, 2, 4], (300, 3)).astype(np.float32)
    gaussians = Gaussians.from_points(points, rng.integers(0, 256, (300, 3), dtype=np.uint8), sh_degree)
    gaussians.scales.fill_(np.log(0.05))
    gaussians.save(folder / "coarse.ply")
    return folder / "coarse.ply"


def a_part(around: Path, number: int = 0) -> Scene:
    part = Part("tiny", "a", number, 2, HALVES, ["view0.png"])
    return replace(tiny_scene(), part=part, around=around)


def in_cell(gaussians: Gaussians, number: int = 0) -> torch.Tensor:
    return torch.from_numpy(cell_of(HALVES, gaussians.means.detach().numpy()) == number)


def test_beside_the_parts_lies_the_coarse_whole(made: Split, monkeypatch: pytest.MonkeyPatch) -> None:
    assert made.coarse is not None
    whole = hqgs.load(made.folder.parent / "city")
    coarse = hqgs.load(made.folder / made.coarse.folder)
    assert [view.name for view in coarse.test] == [view.name for view in whole.test]
    assert [view.name for view in coarse.train] == [view.name for view in whole.train]
    assert len(coarse.points) == POINTS
    monkeypatch.setattr(splitting, "COARSE_PHOTOS", 10)
    monkeypatch.setattr(splitting, "COARSE_POINTS", 100)
    few = split(made.folder.parent / "city", made.folder.parent / "few", 4)
    assert few.coarse is not None
    assert few.parts == made.parts
    assert few.coarse.train + few.coarse.held_out == 10
    assert few.coarse.points == POINTS / 15  # every 15th: 96
    assert split(made.folder.parent / "city", made.folder.parent / "one", 1).coarse is None


def test_a_part_starts_from_its_own_points_and_the_coarse_whole(tmp_path: Path) -> None:
    scene = a_part(coarse_file(tmp_path))
    own = Gaussians.from_points(scene.points, scene.point_colors, 3)
    coarse = Gaussians.load(tmp_path / "coarse.ply")
    seen = torch.stack([in_picture(coarse.means.double(), view.camera)[1] for view in scene.train]).any(0)
    kept = coarse.rows(seen | in_cell(coarse))
    assert 0 < len(kept) < len(coarse)
    started = Trainer(scene, tiny_config(leave_out=("growth", "weight"))).gaussians
    first = own.rows(in_cell(own))
    assert len(started) == len(first) + len(kept)
    torch.testing.assert_close(started.means[: len(first)], first.means, rtol=0, atol=0)
    torch.testing.assert_close(started.opacities[len(first) :], kept.opacities, rtol=0, atol=0)
    assert started.sh_degree == 3
    assert not started.shN[len(first) :, 3:].any()


def test_what_other_parts_need_is_neither_removed_nor_reset(tmp_path: Path) -> None:
    trainer = Trainer(a_part(coarse_file(tmp_path)), tiny_config(leave_out=("growth", "weight")))
    assert trainer.config.leave_out == ("growth",)
    assert trainer.config.densify.reset_every >= trainer.config.densify.stop
    before = trainer.gaussians.detached()
    views = trainer.scene.train
    seen = torch.stack([in_picture(before.means.double(), view.camera)[1] for view in views]).any(0)
    kept = before.rows(~seen)
    assert len(kept) > 5
    while trainer.iteration < trainer.length:
        trainer.step()
    after = trainer.gaussians
    assert len(after) > len(before)
    found = {row.tobytes() for row in after.means.detach().numpy()}
    assert all(row.tobytes() in found for row in kept.means.numpy())


def test_a_run_goes_on_beside_the_same_coarse_scene_alone(tmp_path: Path) -> None:
    scene = a_part(coarse_file(tmp_path))
    trainer = Trainer(scene, tiny_config())
    trainer.step()
    trainer.save(tmp_path / "checkpoint")
    Trainer(scene, tiny_config()).restore(tmp_path / "checkpoint")
    coarse_file(tmp_path, seed=8)
    with pytest.raises(ValueError, match="it began with another coarse scene"):
        Trainer(scene, tiny_config()).restore(tmp_path / "checkpoint")


def test_only_parts_have_surroundings(made: Split, tmp_path: Path) -> None:
    file = coarse_file(tmp_path)
    with pytest.raises(ValueError, match="no part that hqgs split made"):
        hqgs.load(made.folder.parent / "city", around=file)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        hqgs.load(made.folder / "part1", around=tmp_path / "nowhere")
    loaded = hqgs.load(made.folder / "part1", around=file)
    assert loaded.around == file
    assert read_part(made.folder / "part1") == loaded.part


def test_gains_of_the_coarse_whole_go_before_a_parts_own() -> None:
    own = np.array([[0.1] * 3, [-0.1] * 3, [0.3] * 3])
    np.testing.assert_allclose(beside(own, [None] * 3), own)
    found = beside(own, [np.full(3, 0.6), np.full(3, 0.4), None])
    np.testing.assert_allclose(found, [[0.6] * 3, [0.4] * 3, [0.8] * 3])


def test_a_part_keeps_the_brightness_of_the_coarse_whole(tmp_path: Path) -> None:
    scene = a_part(coarse_file(tmp_path))
    learned = [{"name": view.name, "gains": [1.5 + 0.1 * k] * 3} for k, view in enumerate(scene.train)]
    (tmp_path / "report.json").write_text(json.dumps({"learned": learned}))
    method = HQGS(scene, HQGSConfig(formation="none"))
    assert method.formation.kinds == {"exposure"}
    gains = np.array([found.gains for found in method.found()])
    np.testing.assert_allclose(gains[:, 0], [1.5 + 0.1 * k for k in range(len(scene.train))])
    cameras = LearnedCameras(scene, False, False, np.log(gains), seed=0)
    (group,) = cameras.param_groups()
    with torch.no_grad():
        group["params"][0] += 0.5
    cameras.after_step(1, scene.train[0], Gaussians.from_points(scene.points, scene.point_colors))
    logs = np.log([found.gains for found in cameras.found()])
    np.testing.assert_allclose(logs.mean(0), np.log(gains).mean(0))
    assert logs[0, 0] - logs[1, 0] > 0.4


def test_small_photos_of_other_parts_are_guests(made: Split, tmp_path: Path) -> None:
    coarse = hqgs.load(made.folder / "coarse", downscale=2)
    save_cameras(tmp_path, coarse)
    file = coarse_file(tmp_path)
    part = hqgs.load(made.folder / "part2", around=file)
    own = {view.name for view in [*part.train, *part.test]}
    names = [view.name for view in part.guests]
    assert names == sorted(names)
    assert names
    assert not {*names} & own
    assert not {*names} & {view.name for view in coarse.test}
    assert part.part is not None
    inside = part.points[cell_of(part.part.cells, part.points) == 1].astype(float)
    for view in coarse.train:
        pixels, depths = project(view.camera, inside)
        shown = (
            (depths > 0) & (pixels >= 0).all(1) & (pixels < (view.camera.width, view.camera.height)).all(1)
        )
        stands = cell_of(part.part.cells, view.camera.center[None])[0] == 1
        wanted = view.name not in own and bool(stands or shown.mean() >= 0.01)
        assert (view.name in names) == wanted
    (first,) = [view for view in coarse.train if view.name == names[0]]
    assert part.guests[0].image.shape == first.image.shape
    np.testing.assert_allclose(part.guests[0].camera.K, first.camera.K)


def test_guests_come_now_and_then_and_nothing_grows_by_them() -> None:
    scene = tiny_scene()
    schedule = Schedule.of(tiny_config(iterations=90), scene.train, True, guests=4)
    plans = [schedule.plan(k, schedule.start()) for k in range(1, 91)]
    guests = [plan for plan in plans if plan.view >= len(scene.train)]
    assert [plan.iteration for plan in guests] == [*range(GUEST_EVERY, 91, GUEST_EVERY)]
    assert not any(plan.observes or plan.coarse for plan in guests)
    counts = np.bincount([plan.view for plan in plans])
    assert len(counts) == len(scene.train) + 4
    assert np.ptp(counts[: len(scene.train)]) <= 1
    assert np.ptp(counts[len(scene.train) :]) <= 1


def test_what_holds_a_camera_is_a_veil() -> None:
    """Needles 1 long and 0.1 thin, 2 away: along x the camera is 2 standard deviations off, along y 20."""
    points = np.array([[2, 0, 0], [2, 0, 0], [0, 0, 5], [9, 0, 0]], np.float32)
    gaussians = Gaussians.from_points(points, np.full((4, 3), 99, np.uint8), 0)
    gaussians.scales[:] = torch.tensor([1.0, 0.1, 0.1]).log()
    gaussians.quats[1] = torch.tensor([1.0, 0.0, 0.0, 1.0])  # a quarter turn about z
    assert veils(gaussians, np.zeros((1, 3))).tolist() == [True, False, False, False]
    assert veils(gaussians, np.array([[50.0, 0, 0], [2, 2, 0], [9, 0, 0]])).tolist() == [
        False,
        True,
        False,
        True,
    ]


def test_polishing_brings_a_scene_to_its_photos_in_their_exposure(made: Split) -> None:
    city = made.folder.parent / "city"
    scene = hqgs.load(city)
    colors = np.full((len(scene.points), 3), 60, np.uint8)
    start = Gaussians.from_points(scene.points, colors, 0)
    start.opacities.fill_(2.0)
    names = [view.name for view in scene.train]

    def brightness(log_gain: float) -> float:
        photos = {name: np.full(3, log_gain) for name in names}
        after = polished(start, city, photos, (1.0, None), scene.extent, 60)
        assert len(after) == len(start)
        return float(np.mean([after.render(view.camera).mean() for view in scene.test]))

    before = float(np.mean([start.render(view.camera).mean() for view in scene.test]))
    as_taken, much_light = brightness(0.0), brightness(3.0)
    photo = 120 / 255
    assert before < as_taken < photo
    assert as_taken - before > 0.005
    assert before - much_light > 0.005  # of a scene that is darker than its photos
    assert photo_name(1) in names
