"""Cameras that no photo has: where they stand, where they look, and how smoothly they move."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import tiny_scene

import hqgs
from hqgs.photos.pixels import to_uint8
from hqgs.scene.camera_files import load_cameras, load_path, save_cameras, save_path
from hqgs.scene.geometry import project
from hqgs.scene.paths import circle, focus, view_matrix, with_size, world_up
from hqgs.scene.scene import Camera, Scene, View


def ring(count: int, *, radius: float = 3.0, tilt: float = 0.5) -> list[Camera]:
    """Cameras around the origin that look at it from above; z is up."""
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    eyes = [radius * np.array([math.cos(a), math.sin(a), tilt]) for a in angles]
    return [hqgs.look_at(eye, (0, 0, 0), up=(0, 0, 1), width=40, height=30) for eye in eyes]


def test_look_at_puts_the_target_in_the_middle_and_up_upwards() -> None:
    camera = hqgs.look_at((1, 2, 3), (4, -1, 0.5), up=(0, 0, 1), width=100, height=60, fov=50)
    pixels, depths = project(camera, np.array([[4, -1, 0.5], [4, -1, 0.6]]))
    np.testing.assert_allclose(pixels[0], [50, 30], atol=1e-9)
    assert depths[0] == pytest.approx(math.dist((1, 2, 3), (4, -1, 0.5)))
    assert pixels[1][1] < 30  # above
    assert pixels[1][0] == pytest.approx(50)
    np.testing.assert_allclose(camera.center, [1, 2, 3], atol=1e-12)
    assert 2 * math.atan(30 / camera.K[1, 1]) == pytest.approx(math.radians(50))
    assert np.linalg.det(camera.viewmat) == pytest.approx(1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov": 180}, "fov is 180"),
        ({"width": 0}, "the size is 0 x 378"),
        ({"up": (0, 0, 2)}, "up is [0, 0, 2]: it is parallel"),
        ({"up": (0, 1)}, "up is [0, 1], wanted three"),
        ({"target": (0, 0, math.nan)}, "target is "),
        ({"target": (0, 0, 0)}, "up is [0, 1, 0]: it is parallel"),
    ],
)
def test_look_at_refuses(change: dict[str, object], message: str) -> None:
    arguments = {"eye": (0, 0, 0), "target": (0, 0, 1), "up": (0, 1, 0)} | change
    with pytest.raises(ValueError, match="^" + message.replace("[", r"\[")):
        hqgs.look_at(**arguments)  # type: ignore[arg-type]


def test_up_and_focus_of_cameras_on_a_ring() -> None:
    cameras = ring(9)
    np.testing.assert_allclose(world_up(cameras), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(focus(cameras), [0, 0, 0], atol=0.05)
    np.testing.assert_allclose(world_up(cameras[:1]), -cameras[0].viewmat[1, :3], atol=1e-9)


def on_its_side(camera: Camera) -> Camera:
    """The same camera turned so that left in its picture is up: a quarter turn clockwise shows it."""
    right, down, forward = camera.viewmat[:3, :3]
    return Camera(
        camera.height, camera.width, camera.K, view_matrix(np.stack([down, -right, forward]), camera.center)
    )


def test_up_follows_photos_that_were_held_on_their_side(tmp_path: Path) -> None:
    cameras, turns = ring(9), [k % 4 for k in range(9)]
    stored = []
    for camera, turn in zip(cameras, turns, strict=True):
        for _ in range(turn):
            camera = on_its_side(camera)
        stored.append(camera)
    held = [camera.turned(turn) for camera, turn in zip(stored, turns, strict=True)]
    np.testing.assert_allclose(world_up(held), [0, 0, 1], atol=1e-9)
    assert np.abs(world_up(stored) - [0, 0, 1]).max() > 0.5
    np.testing.assert_allclose(world_up(held[1:2]), -cameras[1].viewmat[1, :3], atol=1e-9)
    photo = np.zeros((8, 8, 3), np.uint8)
    views = [View(str(k), camera, photo, quarter_turns=turns[k]) for k, camera in enumerate(stored)]
    scene = Scene("a", views, [], np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), "photos")
    save_cameras(tmp_path, scene)
    up = load_cameras(tmp_path).up
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
    centers = np.stack([camera.center for camera in hqgs.orbit(stored, 7, up=2 * up)])
    heights = np.stack([camera.center for camera in hqgs.orbit(cameras, 7)])[:, 2]
    np.testing.assert_allclose(centers[:, 2], heights, atol=1e-9)
    with pytest.raises(ValueError, match=r"up is \[0.0, 0.0, 0.0\], wanted a direction"):
        hqgs.orbit(stored, 7, up=(0, 0, 0))


@pytest.mark.parametrize("turns", [0, 1, 2, 3, 5])
def test_a_turned_camera_sees_the_turned_picture(tmp_path: Path, turns: int) -> None:
    """With the principal point off the middle, and other focal lengths across and along."""
    K = np.array([[40.0, 0, 17], [0, 31, 9], [0, 0, 1]])
    camera = replace(ring(5)[1], K=K, width=36, height=20)
    rng = np.random.default_rng(0)
    model = hqgs.Gaussians.from_points(rng.normal(size=(60, 3)), rng.integers(0, 255, (60, 3), np.uint8), 0)
    with torch.no_grad():
        stored, turned = (model.render(c).numpy() for c in (camera, camera.turned(turns)))
    np.testing.assert_allclose(turned, np.rot90(stored, -turns), atol=2e-5)
    assert stored.std() > 0.04
    photo, mask = to_uint8(stored), np.zeros(stored.shape[:2], bool)
    mask[:, :5] = True
    views = [View("a.jpg", camera, photo, mask, quarter_turns=turns % 4)]
    save_cameras(tmp_path, Scene("a", views, [], np.zeros((1, 3)), np.zeros((1, 3), np.uint8), "photos"))
    (known,) = load_cameras(tmp_path).views
    np.testing.assert_allclose(known.camera.K, camera.turned(turns).K)
    np.testing.assert_allclose(known.camera.viewmat, camera.turned(turns).viewmat)
    assert known.photo is not None
    assert known.mask is not None
    assert np.array_equal(np.asarray(Image.open(known.mask)) == 255, np.rot90(mask, -turns))
    off = np.asarray(Image.open(known.photo)).astype(float) - np.rot90(photo, -turns)
    assert np.sqrt(np.square(off).mean()) < 12  # JPEG


def test_a_path_goes_through_its_cameras_at_an_even_speed() -> None:
    cameras = ring(8)
    shuffled = [cameras[k] for k in (3, 0, 6, 1, 7, 4, 2, 5)]  # as the files' names may have it
    path = hqgs.camera_path(shuffled, 200)
    assert len(path) == 200
    centers = np.stack([camera.center for camera in path])
    for camera in cameras:
        nearest = np.linalg.norm(centers - camera.center, axis=1).min()
        assert nearest < 0.08
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 1.3 * np.median(steps)
    assert steps.sum() < 1.1 * 2 * math.pi * 3 * 7 / 8  # a walk around, no zigzag
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 3, atol=0.15)
    for camera in path[::20]:
        R = camera.viewmat[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert math.dist(project(camera, np.zeros((1, 3)))[0][0], (20, 15)) < 2  # still looks there


def test_a_path_keeps_an_order_that_was_given() -> None:
    """There and back, through more cameras than a path of photos takes."""
    eyes = [(x, 0.0, 0.0) for x in (*range(40), *range(38, -1, -1))]
    cameras = [hqgs.look_at(eye, (20, 99, 0), up=(0, 0, 1)) for eye in eyes]
    path = hqgs.camera_path(cameras, 79, sort=False)
    np.testing.assert_allclose([camera.center[0] for camera in path], [eye[0] for eye in eyes], atol=0.2)


def test_a_path_cuts_where_no_camera_stood() -> None:
    """Two walks, 32 of their steps apart, and a camera alone in between."""
    eyes = [(k + begin, 0.0, 0.0) for k in range(9) for begin in (0, 40)]
    cameras = [hqgs.look_at(eye, (24, 99, 0), up=(0, 0, 1)) for eye in [*eyes, (24.2, 1.0, 0.0)]]
    places = [
        np.stack([c.center for c in hqgs.camera_path(cameras, 61, cuts=cuts)]) for cuts in (False, True)
    ]
    gaps = [((p[:, 0] > 8.01) & (p[:, 0] < 39.99)).sum() for p in places]
    assert gaps[0] > 20
    assert gaps[1] == 0
    steps = np.linalg.norm(np.diff(places[1], axis=0), axis=1)
    assert len(places[1]) == 61
    assert (steps > 1).sum() == 1
    assert np.delete(steps, steps.argmax()).max() < 1.1 * np.median(steps)
    still = [cameras[0]] * 3
    assert len(hqgs.camera_path(still, 4, cuts=True)) == 4


def test_a_closed_path_ends_beside_its_start() -> None:
    centers = np.stack([camera.center for camera in hqgs.camera_path(ring(8), 100, closed=True)])
    step = np.linalg.norm(centers[1] - centers[0])
    assert np.linalg.norm(centers[-1] - centers[0]) == pytest.approx(step, rel=0.2)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_paths_of_few_cameras(count: int) -> None:
    cameras = ring(7)[:count]
    path = hqgs.camera_path(cameras, 5)
    ends = {tuple(np.round(path[k].center, 6)) for k in (0, -1)}
    assert ends == {tuple(np.round(cameras[k].center, 6)) for k in (0, count - 1)}
    assert hqgs.camera_path([*cameras, cameras[-1]], 5)[-1].width == 40  # the same camera twice
    assert len(hqgs.camera_path(cameras, 1)) == 1
    with pytest.raises(ValueError, match="cameras is empty"):
        hqgs.camera_path([], 5)
    with pytest.raises(ValueError, match="frames is 0"):
        hqgs.camera_path(cameras, 0)


def test_an_orbit_of_cameras_around_follows_them() -> None:
    path = hqgs.orbit(ring(9), 30)
    centers = np.stack([camera.center for camera in path])
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 3, atol=0.1)
    np.testing.assert_allclose(centers[:, 2], 1.5, atol=0.1)
    assert np.array_equal(path[0].K, ring(1)[0].K)


def test_an_orbit_of_cameras_on_one_side_stays_there() -> None:
    scene = tiny_scene()
    path = hqgs.orbit([view.camera for view in scene.train], 30)
    centers = np.stack([camera.center for camera in path])
    assert np.abs(centers).max() < 0.7  # theirs are within 0.3 of the origin
    assert np.abs(centers).max() > 0.05
    assert all(camera.viewmat[2, 2] > 0.9 for camera in path)


def test_an_orbit_of_gaussians_shows_them_whatever_lies_far_away() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal([5, 6, 7], 0.5, (400, 3)).astype(np.float32)
    points[0] = 1e6
    model = hqgs.Gaussians.from_points(points, np.full((400, 3), 200, np.uint8))
    model.opacities[1], model.means[2] = -20, torch.nan
    path = hqgs.orbit(model, 12, up=(0, 0, 1))
    for camera in path:
        pixels, depths = project(camera, points[3:].astype(np.float64))
        inside = (depths > 0) & (pixels > 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        assert inside.mean() > 0.9
        assert camera.center[2] > 7
    with pytest.raises(ValueError, match="the scene is empty"):
        hqgs.orbit(hqgs.Gaussians(**{k: t[:0] for k, t in model.named().items()}))


def test_circle_and_size() -> None:
    with pytest.raises(ValueError, match="radius is 0"):
        circle((0, 0, 0), 0)
    with pytest.raises(ValueError, match="frames is 0"):
        circle((0, 0, 0), 1, frames=0)
    camera = with_size(ring(1)[0], 80, 120)
    assert (camera.width, camera.height) == (80, 120)
    np.testing.assert_allclose(project(camera, np.zeros((1, 3)))[0][0], [40, 60])
    assert camera.K[1, 1] / 120 == pytest.approx(ring(1)[0].K[1, 1] / 30)
    assert camera.K[0, 0] == camera.K[1, 1]


def test_the_cameras_of_a_run_come_back(tmp_path: Path) -> None:
    scene = tiny_scene()
    save_cameras(tmp_path, scene)
    known = load_cameras(tmp_path)
    assert [v.name for v in known.views] == [v.name for v in (*scene.train, *scene.test)]
    assert [len(known.train), len(known.test)] == [5, 1]
    for found, view in zip(known.views, (*scene.train, *scene.test), strict=True):
        assert np.array_equal(found.camera.K, view.camera.K)
        assert np.array_equal(found.camera.viewmat, view.camera.viewmat)
        assert found.photo is not None
        assert found.photo.is_file()
        assert found.mask is None
        found.photo.unlink()
    assert {view.photo for view in load_cameras(tmp_path).views} == {None}
    np.testing.assert_allclose(known.up, [0, -1, 0], atol=1e-9)


def test_a_path_file_is_nerfstudios(tmp_path: Path) -> None:
    camera = hqgs.look_at((1, 2, 3), (0, 0, 0), up=(0, 0, 1), width=64, height=48, fov=40)
    save_path(tmp_path / "path.json", [camera, *ring(1)], fps=25)
    value = json.loads((tmp_path / "path.json").read_text())
    pose = np.array(value["camera_path"][0]["camera_to_world"]).reshape(4, 4)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3], atol=1e-12)
    forward = -np.array([1, 2, 3]) / math.sqrt(14)
    np.testing.assert_allclose(-pose[:3, 2], forward, atol=1e-12)  # OpenGL looks along -z
    assert pose[2, 1] > 0  # and has y up
    assert value["camera_path"][0]["fov"] == pytest.approx(40)
    (back, _), fps = load_path(tmp_path / "path.json")
    assert fps == 25
    np.testing.assert_allclose(back.viewmat, camera.viewmat, atol=1e-9)
    np.testing.assert_allclose(back.K, camera.K, atol=1e-9)
