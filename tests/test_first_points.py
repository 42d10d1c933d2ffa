"""Points between those of a reconstruction, along edges."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_scene import tiny_config, tiny_scene

from hqgs.model.consistency import SmallPhoto
from hqgs.model.first_points import points_along_edges
from hqgs.pipeline import run_to_end
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
