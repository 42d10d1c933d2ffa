"""The room taken by moving, unfocused and changing cameras, against frames of still ones."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.scenes import wild
from benchmarks.scenes.exposure import Exposure, path_viewmats, render_exposure, shaken, spread, through_lens
from benchmarks.scenes.room import scene
from benchmarks.scenes.room.scene import embedded_cameras, surface_points
from benchmarks.scenes.room.shading import render_depth, render_view
from benchmarks.scenes.shake import path_points
from benchmarks.scenes.sparse import TABLE, sparse_cameras
from benchmarks.scenes.wild import DISTANCE, TRUE_KINDS, PhotoTruth, parse_true_kind, wild_room
from hqgs.scene.scene import Camera, View
from hqgs.scene.sfm.triangulated import SparsePoints

Floats = NDArray[np.float64]


def small_camera(k: int = 3, width: int = 72, height: int = 54) -> Camera:
    return embedded_cameras(width, height)[k]


def light(image: NDArray[np.uint8]) -> Floats:
    """Linear light of a photo of the room: the sRGB curve and the roll-off of the highlights undone."""
    c = image / 255.0
    x = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    over = np.clip((x - 0.7) / 0.3, 0, 0.99)
    return np.minimum(x, 0.7) + 0.3 * over / (1 - over)


def knots_of(seed: int, scale: float = 0.02) -> Floats:
    return wild._draw_knots(small_camera(), scale * 410, np.random.default_rng(seed))


# --- cameras


def test_a_path_turns_and_moves_the_points() -> None:
    """Against the rotation's series and numpy's polynomials."""
    viewmat, knots = small_camera().viewmat, knots_of(0, 0.5)
    times = np.array([-0.5, -0.21, 0.08, 0.5])
    found = path_viewmats(viewmat, knots, times)
    for time, matrix in zip(times, found, strict=True):
        twist = [
            np.polynomial.Polynomial.fit([-0.5, -1 / 6, 1 / 6, 0.5], knots[:, k], 3)(time) for k in range(6)
        ]
        a, b, c = twist[:3]
        cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        turn, term = np.eye(3), np.eye(3)
        for n in range(1, 20):
            term = term @ cross / n
            turn = turn + term
        point = np.array([0.3, -0.2, 4.0])
        before = viewmat[:3, :3] @ point + viewmat[:3, 3]
        np.testing.assert_allclose(
            matrix[:3, :3] @ point + matrix[:3, 3], turn @ before + twist[3:], atol=1e-10
        )


def test_the_centre_moves_by_the_extent() -> None:
    camera = embedded_cameras()[7]
    for seed in range(4):
        knots = wild._draw_knots(camera, 9.0, np.random.default_rng(seed))
        center = np.linalg.inv(camera.viewmat) @ [0, 0, DISTANCE, 1]
        seen = path_viewmats(camera.viewmat, knots, np.linspace(-0.5, 0.5, 101)) @ center
        pixels = seen[:, :3] @ camera.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        extent = np.linalg.norm(pixels[:, None] - pixels, axis=-1).max()
        assert extent == pytest.approx(9.0, rel=0.02)
        times = np.linspace(-0.5, 0.5, 4001)
        middles = (times[1:] + times[:-1]) / 2
        mean = path_points(knots, middles).mean(0)
        np.testing.assert_allclose(mean, 0, atol=1e-6 * np.abs(knots).max())
        assert (np.abs(knots).max(0) > 0).all()  # all six freedoms


def test_samples_are_spread_over_the_pixel_and_over_time() -> None:
    for count in (12, 24, 64):
        points = spread(count)
        np.testing.assert_allclose(points.mean(0), 0.5, atol=1e-12)
        for axis in (0, 1):
            assert abs(np.polyfit(np.arange(count), points[:, axis], 1)[0]) < 1e-12
            # nearly even: no gap is much wider than that of `count` places in a row
            places = np.sort(points[:, axis])
            assert -0.2 < places[0] < places[-1] < 1.2
            assert np.diff(places).max() < 2.5 / count
    assert spread(1).tolist() == [[0.5, 0.5]]


# --- photos


def test_a_shaken_photo_is_the_mean_of_frames() -> None:
    camera, knots, count = small_camera(), knots_of(1), 12
    photo = render_exposure(shaken(camera, knots, count))
    times = (np.arange(count) + 0.5) / count - 0.5
    frames = [
        render_exposure(Exposure([replace(camera, viewmat=viewmat)], offset[None]))
        for viewmat, offset in zip(path_viewmats(camera.viewmat, knots, times), spread(count), strict=True)
    ]
    expected = np.mean([light(frame) for frame in frames], 0)
    difference = np.abs(light(photo) - expected)
    # The frames' shadows have another point of the lamp each than the samples of one photo; 8 bits round.
    assert np.quantile(difference, 0.95) < 0.01
    assert np.abs(light(frames[0]) - expected).mean() > 5 * difference.mean()


def test_the_plane_in_focus_stays_and_others_spread() -> None:
    """Where the samples of one pixel meet surfaces: by the pinholes' own projections."""
    camera, aperture, focus = embedded_cameras()[4], 0.04, 3.0
    lens = through_lens(camera, aperture, focus, 50)
    for depth in (1.5, 3.0, 12.0):
        point = np.linalg.inv(camera.viewmat) @ [0.2, -0.1, depth, 1]
        pixels = []
        for pinhole in lens.cameras:
            p = pinhole.K @ (pinhole.viewmat @ point)[:3]
            pixels.append(p[:2] / p[2])
        pixels = np.array(pixels)
        radius = np.linalg.norm(pixels - pixels.mean(0), axis=1)
        confusion = camera.K[0, 0] * aperture * abs(1 / depth - 1 / focus)
        assert radius.max() == pytest.approx(confusion, rel=0.05, abs=1e-9)
        assert np.square(radius).mean() == pytest.approx(confusion**2 / 2, rel=0.05, abs=1e-9)  # a full disc


def test_what_is_in_focus_is_sharp() -> None:
    camera = embedded_cameras(126, 94)[3]
    depth, sharp = render_depth(camera), light(render_view(camera)).mean(-1)
    photo = light(render_exposure(through_lens(camera, 0.2, 3.2, 40))).mean(-1)

    def detail(image: Floats, part: NDArray[np.bool_]) -> float:
        inner = part[1:, 1:]
        return float(np.abs(np.diff(image, axis=1))[1:][inner].mean())

    near, far = np.abs(depth - 3.2) < 0.15, depth > 7
    assert detail(photo, near) > 0.7 * detail(sharp, near)
    assert detail(photo, far) < 0.5 * detail(sharp, far)


def test_same_bytes_at_any_thread_count() -> None:
    made = shaken(embedded_cameras(100, 75)[5], knots_of(6), 4)
    first = render_exposure(made, threads=1)
    assert render_exposure(made, threads=3).tobytes() == first.tobytes()


# --- scenes


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Points without COLMAP; counts the photos that are rendered."""
    rendered: list[int] = []
    real = render_exposure

    def cast(views: list[View]) -> SparsePoints:
        return surface_points(views, 300)._replace(note="cast")

    def counting(*args: object, **named: object) -> NDArray[np.uint8]:
        rendered.append(1)
        return real(*args, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(scene, "sfm_points", cast)
    monkeypatch.setattr(wild, "render_exposure", counting)
    return rendered


def make(kind: str, cache: Path | None = None, seed: int = 0) -> wild.WildRoom:
    return wild_room(kind, seed, cache, 24, 18, num_views=6)


@pytest.mark.parametrize("kind", [*TRUE_KINDS, "true-shake:3"])
def test_a_wild_room(kind: str, quick: list[int], tmp_path: Path) -> None:
    room = make(kind, tmp_path / "cache")
    assert len(quick) == 5
    assert [v.name for v in room.scene.train] == [v.name for v in room.clean.train] == list(room.truth)
    assert room.scene.test == room.clean.test
    for view, clean in zip(room.scene.train, room.clean.train, strict=True):
        assert view.camera is clean.camera
        assert view.image.dtype == np.uint8
        name, _ = parse_true_kind(kind, 24)
        truth = room.truth[view.name]
        assert (view.image != clean.image).any()
        if view in room.scene.train[::4]:
            again = wild.taken(name, view.camera, truth)
            np.testing.assert_array_equal(view.image, again)  # the truth is what made the photo
    for view in room.scene.test:
        np.testing.assert_array_equal(view.image, render_view(view.camera))
    assert room.scene.notes[-1].startswith(f"photographed with {kind.partition(':')[0]}:")
    assert "seed 0: all training photos (5)" in room.scene.notes[-1]
    before = len(quick)
    kept = make(kind, tmp_path / "cache")
    assert len(quick) == before  # read back
    for view, same in zip(room.scene.train, kept.scene.train, strict=True):
        np.testing.assert_array_equal(view.image, same.image)
    other = make(kind, tmp_path / "cache", seed=1)
    assert (other.scene.train[0].image != room.scene.train[0].image).any()


def test_the_truth_of_each_kind() -> None:
    cameras = embedded_cameras(num_views=200)
    for kind, (name, value) in {k: parse_true_kind(k) for k in TRUE_KINDS}.items():
        drawn = [wild._draw(name, value, c, np.random.default_rng([0, k])) for k, c in enumerate(cameras)]
        neutral = PhotoTruth()
        if kind == "true-shake":
            extents = [truth.extent for truth in drawn]
            assert 2.4 <= min(extents) < 3
            assert 11.4 < max(extents) <= 12
            assert all(truth.record(kind)["path"] == truth.path.tolist() for truth in drawn)
        else:
            assert all((truth.path == neutral.path).all() for truth in drawn)
        if kind == "true-defocus":
            radii = [410 * truth.aperture / DISTANCE for truth in drawn]
            assert 0.8 <= min(radii) < 1.0
            assert 3.8 < max(radii) <= 4.0
            focus = np.array([truth.focus for truth in drawn])
            assert 2.5 <= focus.min() < 2.6
            assert 7 < focus.max() <= 8
            assert np.median(1 / focus) == pytest.approx((1 / 2.5 + 1 / 8) / 2, abs=0.03)


def test_bad_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown kind 'fog'; the room has: true-shake, true-defocus"):
        wild_room("fog")
    with pytest.raises(ValueError, match=r"true-shake is 0\.1, wanted the longest extent of a shake in px"):
        wild_room("true-shake:0.1")
    with pytest.raises(ValueError, match="true-defocus is x, wanted the largest radius"):
        wild_room("true-defocus:x")
    with pytest.raises(ValueError, match="seed is -1"):
        wild_room("true-shake", seed=-1)
    assert parse_true_kind("true-shake", 252) == ("true-shake", 6.0)


def test_cameras_around_the_table() -> None:
    cameras = sparse_cameras()
    for camera in cameras:
        p = camera.viewmat @ [*TABLE, 1.0]
        assert 2.3 < p[2] < 3.4
        x, y = (camera.K @ p[:3])[:2] / p[2]
        assert 150 < x < 354
        assert 110 < y < 270
    rays = [np.array(TABLE) - camera.center for camera in cameras]
    angles = [
        math.degrees(math.acos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
        for a, b in zip(rays[2:], rays[:-2], strict=True)
    ]
    assert 5 < np.median(angles) < 20
