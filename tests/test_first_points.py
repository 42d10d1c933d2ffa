"""Points between those of a reconstruction: along edges, found back in photos, where depths agree."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_learned_cameras import textured_scene
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.model.first_points import Agreement, SmallPhoto, points_along_edges
from hqgs.pipeline import run_to_end
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import Camera, Scene, View
from hqgs.training.config import HQGSConfig
from hqgs.training.rules import PIXELS
from hqgs.training.trainer import Trainer

NORMAL, OFFSET = np.array([0.3, -0.2, 1.0]), 5.0  # the plane NORMAL . x = OFFSET


def plane_view(name: str = "a", angle: float = 0.0, mask: np.ndarray | None = None) -> View:
    """A photo, 64 x 48, with one vertical edge at column 20, of a camera before the plane."""
    K = np.array([[60.0, 0, 33], [0, 62.0, 23], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    viewmat[:3, 3] = [0.1, -0.2, 0.3]
    photo = np.full((48, 64, 3), 50, np.uint8)
    photo[:, 20:] = 200
    return View(name, Camera(64, 48, K, viewmat), photo, mask)


def on_the_plane(view: View, pixels: np.ndarray) -> np.ndarray:
    """Where the rays through pixels [M, 2] meet the plane, [M, 3]."""
    R, t = view.camera.viewmat[:3, :3], view.camera.viewmat[:3, 3]
    rays = np.linalg.solve(view.camera.K, np.vstack([pixels.T, np.ones(len(pixels))])).T @ R
    center = -R.T @ t
    return center + rays * ((OFFSET - center @ NORMAL) / (rays @ NORMAL))[:, None]


class Plane:
    """What photos of the plane agree on: every pixel, at its depth."""

    def __init__(self, views: list[View]) -> None:
        self.views, self.looks = views, [SmallPhoto.of(view) for view in views]
        self.ranges = [np.zeros((0, 2))]

    def depths(self, number: int, pixels: np.ndarray, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        camera = self.views[number].camera
        self.ranges.append(ranges)
        depths = on_the_plane(self.views[number], pixels) @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        return depths, np.ones(len(pixels), bool)


def found_points(views: list[View], *arguments: Any, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return points_along_edges(views, *arguments, seed, Plane(views))[:2]  # type: ignore[arg-type]


CORNERS = np.array([[0.0, 0], [64, 0], [0, 48], [64, 48], [30, 20]])


def test_they_lie_on_the_surface_between_the_points_and_mostly_on_edges() -> None:
    views = [plane_view("a"), plane_view("b", 0.1)]
    points = np.concatenate([on_the_plane(view, CORNERS) for view in views]).astype(np.float32)
    points = np.concatenate([points, [[0, 0, 1], [0, 0, 900]]]).astype(np.float32)  # which neither view sees
    seen = {"a": np.arange(5), "b": np.arange(5, 10)}
    found, colors = found_points(views, points, seen, 401)
    assert (found.dtype, found.shape) == (np.float32, (401, 3))
    assert (colors.dtype, colors.shape) == (np.uint8, (401, 3))
    np.testing.assert_allclose(found @ NORMAL, OFFSET, rtol=1e-5)
    for view, own, shown in zip(views, np.split(found, [200]), np.split(colors, [200]), strict=True):
        inside = own @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        x, y, _ = (inside @ view.camera.K.T / inside[:, 2:]).T
        np.testing.assert_allclose(np.abs(np.stack([x, y]) % 1), 0.5, atol=1e-3)  # centres of pixels
        np.testing.assert_array_equal(shown, view.image[y.astype(int), x.astype(int)])
        assert len(np.unique(np.stack([x, y]).round(1), axis=1).T) == len(own)
        near = np.abs(x - 20) < 4
        assert 0.6 < near.mean() < 0.95  # 1/8 of all pixels
    again, _ = found_points(views, points, seen, 401)
    other, _ = found_points(views, points, seen, 401, seed=1)
    assert np.array_equal(found, again)
    assert not np.array_equal(found, other)


def test_depths_are_sought_around_those_of_the_nearest_points() -> None:
    view = plane_view()
    near, far = on_the_plane(view, np.array([[8.0, 8], [12, 8], [8, 12], [12, 12], [10, 6], [6, 10]])), None
    far = 3 * on_the_plane(view, np.array([[50.0, 40], [54, 40], [50, 44], [54, 44], [52, 38], [48, 42]]))
    points = np.concatenate([near, far]).astype(np.float32)
    asked = Plane([view])
    points_along_edges([view], points, {"a": np.arange(12)}, 3000, 0, asked)  # type: ignore[arg-type]
    ranges = np.concatenate(asked.ranges)
    depths = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
    assert ranges.min() < depths.min() < depths.max() < ranges.max()
    alone = ranges[:, 1] < 1.8 * 1.6 * depths[:6].max()  # beside the near ones
    assert 0.2 < alone.mean() < 0.8
    assert (ranges[alone, 0] < depths[:6].min()).all()


def test_masked_pixels_flat_photos_and_views_without_points() -> None:
    mask = np.zeros((48, 64), bool)
    mask[:, 40:] = True
    view = plane_view(mask=mask)
    points = on_the_plane(view, CORNERS).astype(np.float32)
    found, _ = found_points([view], points, {"a": np.arange(5)}, 100)
    inside = found @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
    assert len(found) == 100
    assert ((inside @ view.camera.K.T)[:, 0] / inside[:, 2] > 40).all()
    all_of_them, _ = found_points([view], points, {"a": np.arange(5)}, 10_000)
    assert len(all_of_them) == 48 * 24
    black = replace(view, image=np.zeros_like(view.image), mask=None)
    assert len(found_points([black], points, {"a": np.arange(5)}, 100)[0]) == 100
    hidden = replace(view, mask=np.zeros_like(mask))
    behind = {"a": np.arange(5), "b": np.arange(2), "c": np.arange(0)}
    for given, count in (
        ([hidden], 100),
        ([plane_view("b"), plane_view("c"), plane_view("d")], 100),
        ([view], 0),
    ):
        found, colors = found_points(given, points, behind, count)
        assert (found.shape, colors.shape) == ((0, 3), (0, 3))
    turned = plane_view(angle=np.pi)
    assert len(found_points([turned], points, {"a": np.arange(5)}, 100)[0]) == 0


def with_tracks(scene: Scene) -> Scene:
    return replace(scene, seen={view.name: np.arange(len(scene.points)) for view in scene.train})


def told(trainer: Trainer) -> dict[str, str]:
    return {item.what: item.why for item in trainer.left_out()}


def longest_to_shortest(trainer: Trainer) -> np.ndarray:
    scales = trainer.gaussians.scales.detach().exp().numpy()
    return scales.max(1) / scales.min(1)


def run_report(trainer: Trainer, out: Path) -> str:
    run_to_end(trainer, out)
    return (out / "report.json").read_text()


def test_hqgs_starts_from_them_where_points_are_few(tmp_path: Path) -> None:
    scene = with_tracks(tiny_scene())
    few, known = len(scene.points), {name: rows[:20] for name, rows in (scene.seen or {}).items()}
    sparse = replace(scene, points=scene.points[:20], point_colors=scene.point_colors[:20], seen=known)
    pixels = sum(view.image[..., 0].size for view in scene.train)

    def trainer(scene: Scene, formation: str = "noise:6", **changes: float) -> Trainer:
        hqgs = HQGSConfig(formation=formation, gaussians_per_pixel=0.2, **changes)  # type: ignore[arg-type]
        return Trainer(scene, tiny_config(method="hqgs", hqgs=hqgs))

    started = trainer(sparse)
    assert 3 * 20 < len(started.gaussians) <= int(0.2 * pixels)
    assert (longest_to_shortest(started) == 1).all()
    np.testing.assert_array_equal(started.gaussians.means[:20].detach().numpy(), sparse.points)
    assert "first points along edges" not in told(started)
    (note,) = json.loads(run_report(started, tmp_path))["notes"]
    assert (
        note
        == f"training started from the scene's 20 points and {started.first_points - 20} found along edges"
    )
    assert len(trainer(sparse, first_points=0.0).gaussians) == 20
    clean = trainer(sparse, formation="none")
    assert 20 < len(clean.gaussians) <= max(30, pixels // PIXELS)
    assert (longest_to_shortest(clean) > 2).all()
    enough = trainer(scene, first_points=0.01)
    assert len(enough.gaussians) == few
    assert "points are enough" in told(enough)["first points along edges"]
    untold = trainer(replace(sparse, seen=None))
    assert len(untold.gaussians) == 20
    assert "does not say" in told(untold)["first points along edges"]


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_a_share_out_of_range_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match=r"first_points is .*, wanted 0 to 1"):
        HQGSConfig(first_points=share)


# --- First points that photos find back in each other


SCENE = textured_scene(8, 96)  # a plane at depth 1


def found(views: list[View], count: int = 800) -> tuple[np.ndarray, np.ndarray, float]:
    assert SCENE.seen is not None
    agreement = Agreement(views, SCENE.seen)
    return points_along_edges(views, SCENE.points, SCENE.seen, count, 0, agreement, found_back=True)


def off_the_plane(points: np.ndarray) -> np.ndarray:
    camera = SCENE.train[0].camera
    return np.abs((points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2] - 1)


def test_they_lie_on_the_surface_and_are_the_same_for_any_number_of_threads() -> None:
    points, colors, agreed = found(SCENE.train)
    assert points.dtype == np.float32
    assert colors.shape == points.shape
    assert 0.8 * 800 < len(points) <= 800
    assert np.mean(off_the_plane(points) < 0.02) > 0.95
    assert SCENE.seen is not None
    agreement = Agreement(SCENE.train, SCENE.seen)
    along = points_along_edges(SCENE.train, SCENE.points, SCENE.seen, 800, 0, agreement)
    assert agreed == along[2]  # rules go by the share of the first look
    for threads in (1, 3):
        hqgs.set_num_threads(threads)
        np.testing.assert_array_equal(found(SCENE.train)[0], points)


def test_two_photos_are_enough_and_must_find_each_other() -> None:
    two = SCENE.train[2:4]
    points, _, agreed = found(two)
    assert agreed == 0  # no two others
    assert len(points) > 400
    assert np.mean(off_the_plane(points) < 0.03) > 0.9
    rng = np.random.default_rng(0)
    noise = replace(two[1], image=rng.integers(0, 256, two[1].image.shape).astype(np.uint8))
    # Of noise some patch looks alike at one of many depths by chance.
    assert len(found([two[0], noise])[0]) < 300


def test_photos_that_know_no_points_and_masks_are_left_alone() -> None:
    mask = np.zeros(SCENE.train[0].image.shape[:2], bool)
    assert len(found([replace(view, mask=mask) for view in SCENE.train])[0]) == 0
    strangers = [replace(view, name=f"{view.name}?") for view in SCENE.train]
    assert found(strangers)[0].shape == (0, 3)
    assert len(found(SCENE.train, 0)[0]) == 0


def test_photos_from_one_place_tell_no_depth() -> None:
    assert SCENE.seen is not None
    copies = [(k, view) for view in SCENE.train for k in range(3)]  # a burst at each place
    views = [replace(view, name=f"{k} {view.name}") for k, view in copies]
    seen = {f"{k} {view.name}": SCENE.seen[view.name] for k, view in copies}
    agreement = Agreement(views, seen)
    for most in (4, 8):
        assert 3 not in {k // 3 for k in agreement.asked(9, most)}
    assert len({k // 3 for k in agreement.asked(9)}) == 4
    points, _, _ = points_along_edges(views, SCENE.points, seen, 1600, 0, agreement, found_back=True)
    assert len(points) > 1000
    assert np.mean(off_the_plane(points) < 0.02) > 0.97  # 0.56 where copies are asked

    still = {str(k): seen[views[0].name] for k in range(6)}
    one_place = [replace(views[0], name=name) for name in still]
    assert not len(
        points_along_edges(
            one_place, SCENE.points, still, 800, 0, Agreement(one_place, still), found_back=True
        )[0]
    )


# --- Depths that other photos agree with


def test_the_surface_is_found_within_the_ranges() -> None:
    scene = textured_scene(8, 96)
    assert scene.seen is not None
    views = scene.train
    rng = np.random.default_rng(0)
    pixels = rng.integers(20, 76, (200, 2)).astype(np.float64) + 0.5
    nearest = rng.uniform(0.6, 0.95, 200)  # the plane is at depth 1
    ranges = np.stack([nearest, rng.uniform(1.05, 1.6, 200)], axis=1)
    depths, agreed = Agreement(views, scene.seen).depths(3, pixels, ranges)
    assert agreed.mean() > 0.9
    points = unproject(views[3].camera, pixels[agreed], depths[agreed])
    found, true = (project(views[0].camera, p)[0] for p in (points, on_plane(views[3], pixels[agreed])))
    assert np.median(np.abs(found - true)) < 0.5  # px


def on_plane(view: View, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    return unproject(view.camera, pixels, np.ones(len(pixels)))


def test_flat_and_contradicting_photos_do_not_agree() -> None:
    scene = textured_scene(8, 96)
    assert scene.seen is not None
    pixels = np.random.default_rng(0).integers(20, 76, (100, 2)).astype(np.float64) + 0.5
    ranges = np.tile([0.7, 1.5], (100, 1))
    flat = [replace(view, image=np.full_like(view.image, 128)) for view in scene.train]
    assert not Agreement(flat, scene.seen).depths(3, pixels, ranges)[1].any()
    rng = np.random.default_rng(1)
    noise = [replace(v, image=rng.integers(0, 256, v.image.shape).astype(np.uint8)) for v in scene.train]
    assert Agreement(noise, scene.seen).depths(3, pixels, ranges)[1].mean() < 0.2
    assert not Agreement(scene.train[:2], scene.seen).depths(0, pixels, ranges)[1].any()
    assert Agreement(scene.train, {}).depths(0, pixels, ranges)[0].shape == (
        100,
    )  # what they see is not known
