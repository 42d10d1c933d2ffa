"""The embedded scene: geometry against brute force, pictures against projection, points and cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.scenes.room import scene, shading
from benchmarks.scenes.room.raycast import Box, Cylinder, Ellipsoid, Panel, Shape, Surface, Torus, nearest
from benchmarks.scenes.room.scene import embedded_cameras, embedded_scene, look_at, sfm_points, surface_points
from benchmarks.scenes.room.shading import render_depth, render_view
from benchmarks.scenes.room.studio import studio
from hqgs.scene import known_points, room
from hqgs.scene.known_points import with_points
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.sfm import run
from hqgs.scene.sfm.likely import PARTNERS
from hqgs.scene.sfm.triangulated import SparsePoints, pairs_of

Points3 = NDArray[np.float64]

INSIDE: list[tuple[Shape, Callable[[Points3], NDArray[np.float64]]]] = [  # negative inside
    (Box((0.5, 0.3, 0.7)), lambda p: np.max(np.abs(p) - [0.5, 0.3, 0.7], -1)),
    (Ellipsoid((0.5, 0.3, 0.7)), lambda p: np.sum((p / [0.5, 0.3, 0.7]) ** 2, -1) - 1),
    (Cylinder(0.4, 1.2), lambda p: np.maximum(np.hypot(p[..., 0], p[..., 2]) - 0.4, np.abs(p[..., 1]) - 0.6)),
    (Torus(0.6, 0.2), lambda p: np.hypot(np.hypot(p[..., 0], p[..., 2]) - 0.6, p[..., 1]) - 0.2),
]


def project(camera: Camera, point: Points3) -> tuple[float, float, float]:
    """Pixel x, y and view-space z of a world point [3]."""
    p = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    x, y, w = camera.K @ p
    return x / w, y / w, float(p[2])


def linear(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    c = image / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize(("shape", "inside"), INSIDE)
def test_first_hit_and_normal(shape: Shape, inside: Callable[[Points3], NDArray[np.float64]]) -> None:
    """Against the implicit function, walked along each ray in small steps."""
    rng = np.random.default_rng(1)
    o = rng.standard_normal((300, 3))
    o *= 2.5 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.6, 0.6, (300, 3)) - o
    with np.errstate(all="ignore"):
        t = shape.hit(tuple(o.T), tuple(d.T))
    steps = np.linspace(0, 2, 8001)
    walked = inside(o[:, None] + steps[:, None] * d[:, None]) < 0
    first = np.where(walked.any(1), steps[walked.argmax(1)], np.inf)
    both = np.isfinite(t) & np.isfinite(first)
    assert both.sum() > 100
    assert (np.isfinite(t) != np.isfinite(first)).sum() <= 3  # a step may miss a graze
    np.testing.assert_allclose(t[both], first[both], atol=5e-4)
    p = o[both] + t[both, None] * d[both]
    assert np.abs(inside(p)).max() < 1e-4
    normal = np.stack(shape.surface(tuple(p.T))[0], -1)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-9)
    slope = np.stack([(inside(p + h) - inside(p - h)) / 2e-5 for h in 1e-5 * np.eye(3)], -1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    assert (np.sum(slope * normal, 1) > 0.999).mean() > 0.98  # edges have no normal


def test_camera_convention() -> None:
    """x right, y down, z forward; the focus is in the middle of the picture and in front."""
    for camera in embedded_cameras(num_views=24):
        R = camera.viewmat[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
        x, y, z = project(camera, np.array(scene.FOCUS))
        assert (x, y) == (pytest.approx(252), pytest.approx(189))
        assert 4 < z < 5
        fx, fy, fz = scene.FOCUS
        assert project(camera, np.array([fx + 0.1, fy, fz]))[0] > x + 5
        assert project(camera, np.array([fx, fy + 0.1, fz]))[1] > y + 5


def test_depth_is_view_space_z_at_pixel_centres() -> None:
    """The red ball, by the quadratic equation in the camera's frame."""
    camera = embedded_cameras(84, 63)[3]
    ball = next(s for s in studio().surfaces if s.occludes == 0.27)
    x, y, _ = project(camera, np.array(ball.center))
    i, j = int(y), int(x)
    ray = np.linalg.solve(camera.K, [j + 0.5, i + 0.5, 1.0])
    c = camera.viewmat[:3, :3] @ np.array(ball.center) + camera.viewmat[:3, 3]
    roots = np.roots([ray @ ray, -2 * ray @ c, c @ c - 0.27**2])
    assert render_depth(camera)[i, j] == pytest.approx(float(roots.min()), abs=1e-9)


def test_corners_of_the_eye_chart() -> None:
    """Just inside a corner lies bright paper at the panel's depth, just outside the darker wall behind."""
    chart = next(
        s for s in studio().surfaces if isinstance(s.shape, Panel) and s.shape.size == (1.6, 2.2)
    )  # upright, parallel to the wall
    for camera in embedded_cameras()[1:2]:
        photo, depth = linear(render_view(camera, samples=2)).mean(-1), render_depth(camera)
        for sx, sy in ((-1, -1), (1, -1), (-1, 1)):  # the fourth corner is hidden
            pixels = []
            for margin in (-0.012, 0.06):  # within the border of the paper; past the shadow's start
                offset = np.array([sx * (0.8 + margin), sy * (1.1 + margin), 0])
                x, y, z = project(camera, np.array(chart.center) + offset)
                pixels.append((int(y), int(x), z))
            (i, j, z), (wall_i, wall_j, _) = pixels
            assert depth[i, j] == pytest.approx(z, rel=2e-3)
            assert depth[wall_i, wall_j] > z + 0.02
            assert photo[i, j] > 1.5 * photo[wall_i, wall_j]


def test_depth_range() -> None:
    depth = render_depth(embedded_cameras(126, 94)[22])
    assert 1 < depth.min() < 2
    assert depth.max() == pytest.approx(20, rel=0.1)  # the landscape behind the window


def test_culling_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = embedded_cameras(70, 50, 12)[11]
    surfaces = studio().surfaces
    y, x = np.mgrid[:50, :70] + 0.5
    rays = np.linalg.inv(camera.K @ camera.viewmat[:3, :3]) @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    with np.errstate(all="ignore"):
        every = np.ones((len(surfaces), 1), bool)
        t, _ = nearest(surfaces, every, tuple(camera.center.tolist()), tuple(rays[:, None, :]))
    np.testing.assert_allclose(render_depth(camera), t.reshape(50, 70), rtol=1e-9)

    photo = render_view(camera, samples=1)
    loose = replace(studio())
    bound = np.full((len(loose.casters), 3), np.inf)
    loose.__dict__["lamp_boxes"] = (-bound, bound)  # every caster may shade every block
    monkeypatch.setattr(shading, "studio", lambda: loose)
    assert (render_view(camera, samples=1) == photo).all()


def test_same_bytes_at_any_thread_count() -> None:
    camera = embedded_cameras(150, 112)[5]
    first = render_view(camera, samples=2, threads=1)
    assert first.shape == (112, 150, 3)
    assert first.dtype == np.uint8
    for threads in (2, 5):
        assert render_view(camera, samples=2, threads=threads).tobytes() == first.tobytes()


def test_sizes_agree() -> None:
    """A render at twice the size, averaged in linear light, is the small render."""
    small = linear(render_view(embedded_cameras(126, 94)[2], samples=4))
    large = linear(render_view(embedded_cameras(252, 188)[2], samples=3))
    pooled = large.reshape(94, 2, 126, 2, 3).mean((1, 3))
    assert np.sqrt(np.mean((small - pooled) ** 2)) < 0.02
    assert np.sqrt(np.mean((small[:, 1:] - pooled[:, :-1]) ** 2)) > 0.06  # a pixel's shift would show


def test_highlight_moves_with_the_view_and_paper_does_not() -> None:
    ball = next(s for s in studio().surfaces if s.occludes == 0.27)
    center, eye = np.array(ball.center), np.array([0, -0.2, 0])
    half = studio().lamp_frame[2] + (eye - center) / np.linalg.norm(eye - center)
    place = center + 0.27 * half / np.linalg.norm(half)  # where the first camera sees the highlight
    paper = np.array([-1.15 + 0.6, -1.35 - 0.9, 7.96])
    seen: dict[str, list[NDArray[np.float64]]] = {"ball": [], "paper": []}
    for x in (0.0, 1.0):
        viewmat = look_at(eye + np.array([x, 0, 0]), np.array(scene.FOCUS))
        camera = replace(embedded_cameras()[0], viewmat=viewmat)
        photo, depth = render_view(camera, samples=1), render_depth(camera)
        for name, point in (("ball", place), ("paper", paper)):
            u, v, z = project(camera, point)
            assert depth[int(v), int(u)] == pytest.approx(z, rel=0.02)
            seen[name].append(photo[int(v), int(u)].astype(float))
    assert seen["ball"][0].sum() > seen["ball"][1].sum() + 100
    assert np.ptp(seen["paper"], axis=0).max() < 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "samples must be at least 1, got 0"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"camera": Camera(0, 4, np.eye(3), np.eye(4))}, "at least 1 x 1 pixels, got 0 x 4"),
        ({"camera": Camera(4, 4, np.triu(np.ones((3, 3))), np.eye(4))}, "skew 0, got 1.0"),
    ],
)
def test_bad_arguments(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"camera": embedded_cameras(8, 6)[0]}
    with pytest.raises(ValueError, match=message):
        render_view(**(arguments | change))  # type: ignore[arg-type]


def test_bad_scene_arguments() -> None:
    with pytest.raises(ValueError, match="num_views must be at least 2"):
        embedded_scene(num_views=1)
    with pytest.raises(ValueError, match="got 0 x 378"):
        embedded_scene(width=0)
    with pytest.raises(FileExistsError):
        embedded_scene(Path(__file__))
    with pytest.raises(ValueError, match="views must not be empty"):
        sfm_points([])
    with pytest.raises(ValueError, match="parallel to the line from eye to target"):
        look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]))


def views_of(width: int, height: int, count: int, first: int | None = None) -> list[View]:
    cameras = embedded_cameras(width, height, count)[:first]
    return [View(f"v{k}.png", c, render_view(c)) for k, c in enumerate(cameras)]


def depth_error(views: list[View], points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Relative error of the points' depth against the nearest of the views' depth maps, [P]."""
    error = np.full(len(points), np.inf)
    for view in views:
        K, viewmat = view.camera.K, view.camera.viewmat
        inside = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        z = inside[:, 2]
        x, y = (inside @ K.T)[:, :2].T / z
        shown = np.flatnonzero(
            (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height) & (z > 0)
        )
        depth = render_depth(view.camera)[y[shown].astype(int), x[shown].astype(int)]
        error[shown] = np.minimum(error[shown], np.abs(depth / z[shown] - 1))
    return error


def test_points_by_colmap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(252, 189, 5)
    points, colors, photos, rows, note = sfm_points(views)
    assert note == f"{len(points)} points by COLMAP with the known cameras"
    assert points.dtype == np.float32
    assert colors.shape == points.shape
    assert colors.dtype == np.uint8
    assert np.median(depth_error(views, points)) < 0.01
    assert sorted(points.tolist()) == points.tolist()
    guesses = ["no points in the scene: 1 random one", "another note"]
    scene = Scene("a", views, [], np.zeros((1, 3), np.float32), colors[:1], "llff", guesses, guessed=True)
    found = with_points(scene, tmp_path)
    monkeypatch.setattr(known_points, "triangulated", lambda views: "it was asked again")
    for again in (found, with_points(scene, tmp_path)):
        assert (again.points.tobytes(), again.point_colors.tobytes()) == (points.tobytes(), colors.tobytes())
        assert again.seen is not None
        assert all((again.seen[v.name] == np.unique(rows[photos == k])).all() for k, v in enumerate(views))
        assert again.notes == ["another note", f"no points in the scene: {note}"]
        assert with_points(again) is again
    none = with_points(scene)
    assert none.points is scene.points
    assert none.notes == [*guesses, "COLMAP found no points for these cameras: it was asked again"]
    assert set(rows) == set(range(len(points)))
    assert len(rows) >= 3 * len(points)
    off = [depth_error([views[photo]], points[rows[photos == photo]]) for photo in range(5)]
    assert np.median(np.concatenate(off)) < 0.01


def test_of_many_views_those_are_matched_that_are_near_and_look_alike() -> None:
    (camera,) = embedded_cameras(63, 47, 1)
    axis, views = np.zeros((4, 4)), []
    for k in range(50):  # in a row, the odd ones turned round
        viewmat = np.diag([1.0, 1, 1, 1]) if k % 2 == 0 else np.diag([-1.0, 1, -1, 1])
        axis[:3, 3] = -viewmat[:3, 0] * k
        views.append(View(f"{k}", replace(camera, viewmat=viewmat + axis), np.zeros((47, 63, 3), np.uint8)))
    pairs = pairs_of(views)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert ((pairs[:, 1] - pairs[:, 0]) % 2 == 0).all()
    assert {tuple(pair) for pair in pairs.tolist()} >= {(k, k + 2) for k in range(48)}
    assert np.bincount(pairs.ravel()).min() >= PARTNERS


def test_points_when_colmap_is_late_or_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(63, 47, 3)
    points, _, _, _, note = sfm_points(views, time_limit=0)
    assert note == "4000 points cast onto the surfaces, as COLMAP gave none: COLMAP took more than 0 s"
    assert np.quantile(depth_error(views, points[::8]), 0.9) < 0.02
    assert points.tobytes() == surface_points(views).points.tobytes()
    assert points.tobytes() != surface_points(views, seed=1).points.tobytes()
    exact, paint, photos, rows, _ = surface_points(views[:2], 50, noise=0)
    assert (np.bincount(photos) == 25).all()
    for view, point, color in zip(
        [views[k] for k in photos], exact[rows].astype(np.float64), paint[rows], strict=True
    ):
        x, y, z = project(view.camera, point)
        assert (x % 1, y % 1) == (pytest.approx(0.5, abs=1e-3), pytest.approx(0.5, abs=1e-3))
        assert (view.image[int(y), int(x)] == color).all()
        assert render_depth(view.camera)[int(y), int(x)] == pytest.approx(z, rel=1e-6)

    flat = [replace(v, image=np.full_like(v.image, 128)) for v in views]
    assert "as COLMAP gave none: it found only 0 points" in sfm_points(flat).note
    monkeypatch.setattr(run, "PROGRAM", Path("there", "is", "none"))
    assert "as COLMAP gave none: COLMAP ended with status 2" in sfm_points(views).note


def same_scene(a: Scene, b: Scene) -> bool:
    views = zip(a.train + a.test, b.train + b.test, strict=True)
    return (
        all(v.name == w.name and v.image.tobytes() == w.image.tobytes() for v, w in views)
        and a.points.tobytes() == b.points.tobytes()
        and a.point_colors.tobytes() == b.point_colors.tobytes()
        and {name: rows.tolist() for name, rows in (a.seen or {}).items()}
        == {name: rows.tolist() for name, rows in (b.seen or {}).items()}
        and a.seen is not None
        and a.notes == b.notes
    )


def test_scene_and_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[Camera] = []

    def cast(views: list[View]) -> SparsePoints:
        return surface_points(views, 60)._replace(note="cast")

    def counting(camera: Camera) -> NDArray[np.uint8]:
        rendered.append(camera)
        return render_view(camera, 1)

    monkeypatch.setattr(scene, "render_view", counting)
    monkeypatch.setattr(scene, "sfm_points", cast)

    def make(width: int = 16) -> tuple[Scene, int]:
        before = len(rendered)
        made = embedded_scene(tmp_path / "cache", width, 12, num_views=10)
        return made, len(rendered) - before

    first, cost = make()
    assert cost == 10
    assert [v.name for v in first.test] == ["view_00.png", "view_08.png"]
    assert [v.name for v in first.train] == [f"view_{k:02d}.png" for k in (1, 2, 3, 4, 5, 6, 7, 9)]
    assert first.source == "embedded"
    assert first.notes == ["cast"]
    second, cost = make()
    assert cost == 0
    assert same_scene(first, second)

    file = tmp_path / "cache" / "room.npz"
    damages: list[Callable[[], object]] = [
        lambda: file.write_bytes(file.read_bytes()[:-30]),
        lambda: file.write_bytes(file.read_bytes()[:400] + b"-" + file.read_bytes()[401:]),
        lambda: np.savez(file, points=np.zeros(3)),
        lambda: file.unlink(),
        lambda: file.write_bytes(b""),
    ]
    for damage in damages:
        damage()
        remade, cost = make()
        assert cost == 10
        assert same_scene(first, remade)
    assert make()[1] == 0
    other, cost = make(width=18)
    assert cost == 10
    assert other.train[0].image.shape == (12, 18, 3)
    assert not list((tmp_path / "cache").glob(".*"))  # nothing half written


def test_scene_without_cache_takes_points_from_training_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def fake(views: list[View]) -> SparsePoints:
        asked.extend(v.name for v in views)
        return surface_points(views, 30)._replace(note="fake")

    monkeypatch.setattr(scene, "sfm_points", fake)
    made = embedded_scene(width=16, height=12, num_views=17)
    assert asked == [v.name for v in made.train]
    assert [v.name for v in made.test] == ["view_00.png", "view_08.png", "view_16.png"]
    assert made.notes == ["fake"]


def test_surfaces_are_described_well() -> None:
    """Rotations are proper, bounding boxes hold their shapes, and the wires are there."""
    for surface in studio().surfaces:
        R = surface.rotation
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0
    wires = [s for s in studio().surfaces if isinstance(s.shape, Cylinder) and s.shape.radius < 0.01]
    assert len(wires) > 40
    assert all(isinstance(s, Surface) and not s.shadow for s in wires)


def test_what_is_installed_is_what_is_ray_cast() -> None:
    made = room.embedded_scene(504, 378)
    assert (len(made.train), len(made.test)) == (21, 3)
    views = sorted([*made.train, *made.test], key=lambda view: view.name)
    for k, camera in enumerate(embedded_cameras()):
        np.testing.assert_array_equal(views[k].camera.K, camera.K)
        # products of matrices are rounded as the CPU's BLAS does
        np.testing.assert_allclose(views[k].camera.viewmat, camera.viewmat, rtol=0, atol=1e-14)
    # so is light, and seldom another level comes of it
    levels = np.abs(views[5].image.astype(int) - render_view(embedded_cameras()[5]))
    assert levels.max() <= 1
    assert np.count_nonzero(levels) <= 3
    assert made.seen is not None
    assert np.median(depth_error([views[5]], made.points[made.seen["view_05.png"]])) < 0.01
    small = room.embedded_scene(63, 47)
    assert {view.image.shape for view in small.train} == {(47, 63, 3)}
    with pytest.raises(ValueError, match="each side needs 8"):
        room.embedded_scene(9, 7)
