"""Up in a scene, by edges, points or other frames, and the alignment of two frames."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.scenes.room.scene import embedded_cameras
from benchmarks.scenes.room.shading import render_view
from hqgs.scene.formats.colmap import write_colmap
from hqgs.scene.georeference import Georeference
from hqgs.scene.paths import scene_up
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.sfm.align import Similarity, align, camera_centers, refine, rotation_angles
from hqgs.scene.sfm.refine.tracks import Tracks
from hqgs.scene.source import load
from hqgs.scene.upright import direction_of, told_up, with_up

TURN = Rotation.from_euler("xyz", [30, 50, 70], degrees=True).as_matrix()
UP = TURN @ [0, -1, 0]


@pytest.fixture(scope="module")
def room() -> Scene:
    """The room in a turned frame, by somebody who leans by 7 degrees."""
    lean = Rotation.from_euler("z", 7, degrees=True).as_matrix()
    views = []
    for k, camera in enumerate(embedded_cameras(160, 120, 6)):
        held = camera.viewmat.copy()
        held[:3] = lean @ held[:3]
        image = render_view(Camera(160, 120, camera.K, held))
        held[:3, :3] = held[:3, :3] @ TURN.T
        views.append(View(f"{k}.png", Camera(160, 120, camera.K, held), image))
    return Scene("room", views[1:], views[:1], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "colmap")


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(min(float(a @ b), 1.0)))


def noise(room: Scene) -> list[View]:
    rng = np.random.default_rng(0)
    return [replace(v, image=rng.integers(0, 256, v.image.shape, dtype=np.uint8)) for v in room.train[:3]]


def test_upright_edges_tell_up_better_than_how_photos_were_held(room: Scene) -> None:
    assert degrees(scene_up(room), UP) > 5
    found = with_up(room)
    assert degrees(scene_up(found), UP) < 1
    (note,) = found.notes
    stated = float(note.split("within ")[1].split()[0])
    assert degrees(scene_up(found), UP) < stated
    assert "upright edges in" in note


def test_up_is_sought_where_a_scene_is_to_be_trained(room: Scene, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    views = [*room.train, *room.test]
    for view in views:
        Image.fromarray(view.image).save(tmp_path / "images" / view.name)
    shown = np.random.default_rng(2).uniform([-1, -1, 2], [1, 1, 4], (8, 3))  # before the first camera
    viewmat = views[0].camera.viewmat
    points = (shown - viewmat[:3, 3]) @ viewmat[:3, :3]
    cameras = {view.name: view.camera for view in views}
    write_colmap(tmp_path / "sparse" / "0", cameras, points, np.zeros((8, 3), np.uint8), None, 0.0)
    told = load(tmp_path, test_every=0)
    assert degrees(scene_up(told), UP) < 1
    looked_at = load(tmp_path, test_every=0, points=False)
    assert looked_at.world.up is None
    assert looked_at.notes == told.notes[:-1]


def test_gps_tells_up_where_it_is_sure(room: Scene) -> None:
    bare = replace(room, train=noise(room), test=[])
    place = Georeference(1, [0.9, 1.1], np.eye(3).tolist(), UP.tolist(), [1, 2], 40, 38, 1, 500, 0.4)
    told = with_up(replace(bare, world=replace(bare.world, place=place)))
    np.testing.assert_allclose(scene_up(told), UP)
    assert "GPS of 38 photos" in told.notes[0]
    loose = replace(place, tilt=5.0)
    assert with_up(replace(bare, world=replace(bare.world, place=loose))).world.up is None


def test_up_as_it_was_asked_for(room: Scene) -> None:
    asked = told_up(room, direction_of((0, 0, -2)), "as given")
    assert asked.world.up == (0, 0, -1)
    np.testing.assert_allclose(scene_up(asked), [0, 0, -1])
    assert asked.notes[-1] == "up is (0.000, 0.000, -1.000), as given"
    for wrong in ((0, 0, 0), (1, 2), (math.nan, 0, 1)):
        with pytest.raises(ValueError, match=r"up is .*, wanted three numbers"):
            direction_of(wrong)


# --- Alignment of two frames: known similarities, outliers, cameras in a line, and the pictures that decide


Floats = NDArray[np.float64]
TRUE = Similarity(
    0.37, Rotation.from_euler("xyz", [20, -50, 130], degrees=True).as_matrix(), np.array([4, -2, 9.0])
)


def viewmats_of(R: Floats, centers: Floats) -> Floats:
    """World-to-camera matrices [V, 4, 4] of cameras with rows of axes `R` [V, 3, 3]."""
    viewmats = np.tile(np.eye(4), (len(R), 1, 1))
    viewmats[:, :3, :3] = R
    viewmats[:, :3, 3] = -np.einsum("nij,nj->ni", R, centers)
    return viewmats


def rig(rng: np.random.Generator, count: int, spread: tuple[float, float, float] = (1, 0.6, 0.1)) -> Floats:
    turns = Rotation.from_rotvec(0.15 * rng.standard_normal((count, 3))).as_matrix()
    return viewmats_of(turns, rng.standard_normal((count, 3)) * spread + [3, 1, -2])


def moved(viewmats: Floats, similarity: Similarity) -> Floats:
    """The same cameras after x -> s R x + t, from the definition: their centres move, their axes turn."""
    centers = np.array([-m[:3, :3].T @ m[:3, 3] for m in viewmats])
    turned = np.array([m[:3, :3] @ similarity.R.T for m in viewmats])
    return viewmats_of(
        turned, np.array([similarity.scale * similarity.R @ c + similarity.t for c in centers])
    )


def assert_same(found: Similarity, true: Similarity, tolerance: float) -> None:
    assert found.scale == pytest.approx(true.scale, rel=tolerance)
    np.testing.assert_allclose(found.R, true.R, atol=tolerance)
    np.testing.assert_allclose(found.t, true.t, atol=10 * tolerance)


@pytest.mark.parametrize("spread", [(1, 0.6, 0.1), (1, 0, 0)])  # the second: all cameras in a line
@pytest.mark.parametrize("count", [2, 3, 40])
def test_a_known_similarity_is_found(count: int, spread: tuple[float, float, float]) -> None:
    source = rig(np.random.default_rng(count), count, spread)
    target = moved(source, TRUE)
    found, inliers = align(source, target)
    assert inliers.all()
    assert_same(found, TRUE, 1e-9)
    np.testing.assert_allclose(found.viewmats(source), target, atol=1e-8)
    np.testing.assert_allclose(found.points(camera_centers(source)), camera_centers(target), atol=1e-8)


def test_cameras_that_do_not_fit_are_left_out() -> None:
    """5 of 20 cameras are somewhere else in the target; the others err by 0.1 % of the rig."""
    rng = np.random.default_rng(0)
    source = rig(rng, 20)
    noisy = source.copy()
    noisy[:, :3, 3] += 1e-3 * rng.standard_normal((20, 3))
    target = moved(noisy, TRUE)
    target[:3] = moved(rig(rng, 3), TRUE)
    target[3:5, :3, :3] = Rotation.from_rotvec([0, 0.3, 0]).as_matrix() @ target[3:5, :3, :3]
    found, inliers = align(source, target)
    assert not inliers[:5].any()
    assert inliers[5:].sum() >= 13  # at three standard deviations an honest one may be lost
    assert_same(found, TRUE, 2e-3)
    everyone, _ = align(np.delete(source, range(5), 0), np.delete(target, range(5), 0))
    assert_same(found, everyone, 1e-3)


def test_what_leaves_the_frame_open_is_refused() -> None:
    one = rig(np.random.default_rng(0), 1)
    with pytest.raises(ValueError, match="at least 2 cameras, got 1"):
        align(one, one)
    turning = np.tile(one, (4, 1, 1))
    turning[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(4), [0, 0.2, 0])).as_matrix()
    turning[:, :3, 3] = 0
    with pytest.raises(ValueError, match="4 cameras of a frame have one centre"):
        align(turning, turning)


def test_angles_of_rotations() -> None:
    angles = np.array([0, 1e-9, 0.3, 3.1])
    axis = np.array([1, 2, -2]) / 3
    np.testing.assert_allclose(
        rotation_angles(Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()), angles, rtol=1e-6
    )


def test_refining_finds_the_similarity_of_the_pictures() -> None:
    rng = np.random.default_rng(1)
    source = rig(rng, 12, (0.3, 0.2, 0.01))
    points = rng.uniform([1, -1, 2], [5, 3, 4], (80, 3))
    Ks = np.tile(np.array([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]]), (12, 1, 1))
    camera, point = (a.ravel() for a in np.meshgrid(np.arange(12), np.arange(80), indexing="ij"))

    def project(viewmats: Floats, where: Floats) -> Floats:
        pixels = []
        for c, p in zip(camera, point, strict=True):
            x, y, z = Ks[c] @ (viewmats[c, :3, :3] @ where[p] + viewmats[c, :3, 3])
            pixels.append([x / z, y / z])
        return np.array(pixels)

    pixels = project(source, points)
    target = moved(source, TRUE)
    seen = Tracks(points, np.zeros((80, 3), np.uint8), camera, point, pixels)
    wrong = pixels.copy()
    wrong[::10] += 40  # mismatches
    off = Similarity(
        TRUE.scale * 1.05, TRUE.R @ Rotation.from_rotvec([0.03, -0.02, 0.01]).as_matrix(), TRUE.t + 0.05
    )
    for observations, tolerance in ((seen, 1e-9), (replace(seen, xy=wrong), 2e-2)):
        found, apart = refine(off, observations, Ks, target)
        assert_same(found, TRUE, tolerance)
        np.testing.assert_allclose(
            apart, np.linalg.norm(project(target, found.points(points)) - observations.xy, axis=1), atol=1e-9
        )


def test_refining_never_makes_it_worse() -> None:
    rng = np.random.default_rng(2)
    source = rig(rng, 5)
    points = rng.uniform([1, -1, 2], [5, 3, 4], (9, 3))
    Ks = np.tile(np.diag([200.0, 200, 1]), (5, 1, 1))
    drawn = rng.integers(0, 5, 60), rng.integers(0, 9, 60), rng.uniform(-100, 100, (60, 2))
    nonsense = Tracks(points, np.zeros((9, 3), np.uint8), *drawn)
    identity = Similarity(1.0, np.eye(3), np.zeros(3))
    found, apart = refine(identity, nonsense, Ks, source)
    assert np.isfinite(found.t).all()
    assert found.scale > 0
    assert (apart >= 0).all()
