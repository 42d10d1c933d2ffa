"""Which training photos are left out: pictures of a plane, ray-cast, among them blurred, empty and twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hqgs.diagnosis.choice import choose_photos
from hqgs.diagnosis.coverage import Sight
from hqgs.diagnosis.sharpness import Sharpness, look_at_photos
from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.scene import Camera, Scene, View

WIDTH, HEIGHT, FOCAL, DEPTH, PHOTOS = 112, 96, 100.0, 4.0, 12
STEP = DEPTH / FOCAL  # world units: moves the plane by one pixel


@lru_cache(maxsize=1)
def waves() -> tuple[NDArray[np.float64], ...]:
    """Of a picture whose power falls with the frequency as that of photos does; up to 2.5 rad/px."""
    rng = np.random.default_rng(3)
    frequency = np.exp(rng.uniform(np.log(0.05), np.log(2.5), 400)) / STEP
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 400))
    return frequency * np.cos(angle), frequency * np.sin(angle), phase, 1.6 / (frequency * STEP) ** 0.3


def paint(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Levels [H, W, 3] of the plane at columns x [W] and rows y [H]."""
    along, across, phase, height = waves()
    column, row = np.outer(along, x) + phase[:, None], np.outer(y, across)  # of sin(column + row), expanded
    grey = np.cos(row) * height @ np.sin(column) + np.sin(row) * height @ np.cos(column)
    return (120 + grey[..., None] * [1.0, 0.9, 0.8]).clip(2, 253)


def view_at(name: str, x: float, y: float) -> View:
    """A photo of the plane z = DEPTH from (x, y, 0)."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:2, 3] = -x, -y
    columns, rows = (np.arange(side) + 0.5 - side / 2 for side in (WIDTH, HEIGHT))
    picture = paint(x + columns * STEP, y + rows * STEP)
    return View(name, Camera(WIDTH, HEIGHT, K, viewmat), np.rint(picture).astype(np.uint8))


@lru_cache(maxsize=1)
def clean_scene() -> Scene:
    """Twelve photos on a ring of 6 pixels' parallax, two held out, and points that all of them see."""
    angles = 2 * np.pi * np.arange(PHOTOS) / PHOTOS
    train = [
        view_at(f"{k:02d}.png", 6 * STEP * np.cos(a), 6 * STEP * np.sin(a)) for k, a in enumerate(angles)
    ]
    test = [view_at("held_0.png", 0, 0), view_at("held_1.png", STEP, 0)]
    xy = np.random.default_rng(0).uniform(-1, 1, (300, 2)) * [48 * STEP, 40 * STEP]
    points = np.concatenate([xy, np.full((300, 1), DEPTH)], axis=1).astype(np.float32)
    return Scene("plane", train, test, points, np.zeros((300, 3), np.uint8), "test", ["a note"])


def changed(scene: Scene, change: Callable[[View], View], *which: int) -> Scene:
    train = [change(view) if k in which else view for k, view in enumerate(scene.train)]
    return replace(scene, train=train)


def filled(value: float) -> Callable[[View], View]:
    return lambda view: replace(view, image=np.full_like(view.image, value))


def blurred(sigma: float) -> Callable[[View], View]:
    def change(view: View) -> View:
        soft = gaussian_filter(view.image.astype(np.float64), (sigma, sigma, 0))
        return replace(view, image=np.rint(soft).astype(np.uint8))

    return change


def with_noise(view: View, sigma: float, seed: int) -> View:
    noise = np.random.default_rng(seed).normal(0, sigma, view.image.shape)
    return replace(view, image=np.rint(view.image + noise).clip(0, 255).astype(np.uint8))


def left_out(scene: Scene) -> list[str]:
    """Names of the photos left out, after a check that nothing else has changed."""
    chosen, out = choose_photos(scene)
    names = [entry.what.removeprefix("training photo ") for entry in out]
    assert all(entry.why and entry.evidence and (entry.memory_mb or 0) > 0 for entry in out)
    assert [id(v) for v in chosen.train] == [id(v) for v in scene.train if v.name not in names]
    assert chosen.test is scene.test
    assert chosen.points is scene.points
    assert chosen.notes[: len(scene.notes)] == scene.notes
    return names


@pytest.mark.parametrize("kind", ["none", "noise:25", "jpeg:10", "lowres:2", "blur:2", "motion:7", "mixed"])
def test_photos_that_are_equally_bad_all_stay(kind: str) -> None:
    scene = clean_scene()
    if kind != "none":
        scene = degrade_scene(scene, parse_degradation(kind), seed=0)
    chosen, out = choose_photos(scene)
    assert chosen is scene
    assert out == []


def test_blurred_photos_go_the_blurriest_first() -> None:
    scene = changed(changed(clean_scene(), blurred(3), 2, 9), blurred(4), 5)
    assert left_out(scene) == ["05.png", "02.png", "09.png"]
    why, evidence = choose_photos(scene)[1][1].why, choose_photos(scene)[1][1].evidence or ""
    assert "blurrier" in why
    sigma = float(evidence.split("sigma ")[1].split(" px")[0])
    assert sigma == pytest.approx(3, abs=0.5)


def test_noise_does_not_pass_for_sharpness() -> None:
    scene = degrade_scene(changed(clean_scene(), blurred(4), 5), parse_degradation("noise:15"), seed=0)
    assert left_out(scene) == ["05.png"]


def test_slight_blur_and_blur_of_most_photos_stay() -> None:
    assert left_out(changed(clean_scene(), blurred(1.2), 2, 5, 9)) == []
    assert left_out(changed(clean_scene(), blurred(4), *range(7))) == []
    assert left_out(changed(clean_scene(), blurred(4), *range(PHOTOS))) == []


def test_blurred_photo_stays_where_no_other_looks() -> None:
    """It sees a strip of 30 px that no other photo shows."""
    aside = blurred(4)(view_at("aside.png", 36 * STEP, 0))
    clean = clean_scene()
    strip = clean.points[:60] + np.array([60 * STEP, 0, 0], np.float32)
    scene = replace(clean, train=[*clean.train, aside], points=np.concatenate([clean.points, strip]))
    assert left_out(scene) == []
    note = choose_photos(scene)[0].notes[-1]
    assert note.startswith("blurred training photos kept, as fewer than 3 sharper ones see")
    assert "aside.png" in note


def test_three_sharper_photos_must_see_the_same() -> None:
    """Far from the ring: two companions do not suffice, three do."""
    ring = clean_scene()
    points = np.concatenate([ring.points, ring.points + np.array([900 * STEP, 0, 0], np.float32)])
    far = [view_at(f"far_{k}.png", (900 + 3 * k) * STEP, 0) for k in range(4)]
    far[0] = blurred(4)(far[0])
    for companions, gone in ((2, []), (3, ["far_0.png"])):
        scene = replace(ring, train=[*ring.train, *far[: 1 + companions]], points=points)
        assert left_out(scene) == gone


@pytest.mark.parametrize(("value", "name"), [(0, "black"), (255, "white"), (100, "one colour")])
def test_empty_photos_go(value: int, name: str) -> None:
    scene = changed(clean_scene(), filled(value), 1, 4, 7)
    assert left_out(scene) == ["01.png", "04.png", "07.png"]
    entry = choose_photos(scene)[1][0]
    assert entry.why == f"it is all {name}"
    assert f"{value}, {value}, {value}" in (entry.evidence or "")


def test_empty_but_for_noise() -> None:
    scene = changed(clean_scene(), lambda view: with_noise(filled(12)(view), 5, 0), 4)
    assert left_out(scene) == ["04.png"]


def test_dark_photo_and_bare_wall_stay() -> None:
    """A night photo shows something; a wall that most of its neighbours show too is the scene."""
    dim = changed(clean_scene(), lambda view: replace(view, image=view.image // 6), 4)
    assert left_out(dim) == []
    assert left_out(changed(clean_scene(), filled(255), *range(7))) == []


def test_wall_with_grain_is_not_blurred() -> None:
    """Nothing but noise of 9 levels: too much for an empty photo, and no spectrum to compare."""
    scene = changed(clean_scene(), lambda view: with_noise(filled(150)(view), 14, 1), 4)
    assert left_out(scene) == []


def test_masks() -> None:
    """A photo with a mask may be empty; one that is masked all over teaches nothing."""
    half = np.zeros((HEIGHT, WIDTH), bool)
    half[:40] = True
    shown = changed(clean_scene(), lambda view: replace(filled(0)(view), mask=half), 3)
    assert left_out(shown) == []
    hidden = changed(clean_scene(), lambda view: replace(view, mask=np.zeros_like(half)), 3)
    assert left_out(hidden) == ["03.png"]
    assert "mask" in choose_photos(hidden)[1][0].why


def test_values_that_are_not_finite() -> None:
    def spoil(view: View) -> View:
        image = (view.image / 255).astype(np.float32)
        image[3, 4:9] = np.nan
        return replace(view, image=image)

    scene = changed(clean_scene(), spoil, 3)
    assert left_out(scene) == ["03.png"]
    assert choose_photos(scene)[1][0].evidence == f"15 of {3 * WIDTH * HEIGHT} values"


def copies(move: float, **changes: Any) -> list[View]:
    """Photos 1, 4 and 7 once more, the cameras moved by `move` pixels' worth, the photos taken there."""
    found = []
    for k in (1, 4, 7):
        x, y, _ = clean_scene().train[k].camera.center
        found.append(replace(view_at(f"copy_{k}.png", x + move * STEP, y), **changes))
    return found


@pytest.mark.parametrize(("move", "gone"), [(0.0, 3), (0.2, 3), (0.4, 3), (0.7, 0), (2.0, 0)])
def test_copies_go_within_half_a_pixel(move: float, gone: int) -> None:
    clean = clean_scene()
    scene = replace(clean, train=[*clean.train, *copies(move)])
    names = left_out(scene)
    assert len(names) == gone
    pairs = [{f"copy_{k}.png", f"0{k}.png"} for k in (1, 4, 7)]
    assert all(len(pair & set(names)) == (gone > 0) for pair in pairs)
    for entry in choose_photos(scene)[1]:
        moved = float((entry.evidence or "").split("within ")[1].split(" px")[0])
        assert moved == pytest.approx(move, abs=0.02)


def test_the_sharper_one_stays() -> None:
    clean = clean_scene()
    for first, second in ((0.0, 0.35), (0.35, 0.0)):
        pair = [blurred(s)(v) for s, v in zip((first, second), (clean.train[4], copies(0.1)[1]), strict=True)]
        scene = replace(clean, train=[*clean.train[:4], *clean.train[5:], *pair])
        assert left_out(scene) == ["copy_4.png" if first < second else "04.png"]


def test_another_picture_from_the_same_place_stays() -> None:
    clean = clean_scene()
    lit = [replace(view, image=view.image // 2) for view in copies(0)]
    scene = replace(clean, train=[*clean.train, *lit])
    assert left_out(scene) == []
    assert "copy_1.png (as 01.png)" in choose_photos(scene)[0].notes[-1].replace("01.png (as copy_1", "")


@pytest.mark.parametrize("sigma", [4.0, 20.0])
def test_noisy_photos_from_one_place_average_their_noise(sigma: float) -> None:
    """Two exposures stay, with the reason; the very same exposure twice is of no use."""
    views = [*clean_scene().train, *copies(0.1)]
    noisy = [with_noise(view, sigma, k) for k, view in enumerate(views)]
    scene = replace(clean_scene(), train=noisy)
    assert left_out(scene) == []
    note = choose_photos(scene)[0].notes[-1]
    assert f"noise of {sigma:.0f} levels, which several photos average away" in note
    again = replace(noisy[2], name="again.png")
    assert left_out(replace(scene, train=[*noisy, again])) == ["again.png"]


def test_at_least_half_and_three_stay() -> None:
    """Of sixteen photos twelve are one; of four, one can go; of three, none."""
    clean = clean_scene()
    same = [replace(clean.train[0], name=f"same_{k:02d}.png") for k in range(12)]
    scene = replace(clean, train=[*clean.train[1:5], *same])
    chosen, out = choose_photos(scene)
    assert len(chosen.train) == len(out) == 8
    assert chosen.notes[-1].startswith("training photos kept so that at least half of them stay: same_")
    for count, gone in ((4, 1), (3, 0), (1, 0)):
        few = replace(clean, train=[replace(clean.train[0], name=f"{k}.png") for k in range(count)])
        assert len(left_out(few)) == gone


def test_worst_go_first_where_not_all_can() -> None:
    """Of eight photos: two empty, one blurred, two copies; four can go."""
    clean = clean_scene()
    twice = [replace(clean.train[k], name=f"copy_{k}.png") for k in (0, 1)]
    scene = replace(clean, train=[*clean.train[:6], *twice])
    scene = changed(changed(scene, filled(0), 4), blurred(4), 5)
    assert left_out(scene) == ["04.png", "05.png", "copy_0.png", "copy_1.png"]
    scene = changed(scene, filled(0), 3)
    assert left_out(scene)[:2] == ["03.png", "04.png"]
    assert len(left_out(scene)) == 4


def test_held_out_views_do_not_count() -> None:
    """A training photo from a held-out view's place stays, and an empty held-out view changes nothing."""
    clean = clean_scene()
    twin = replace(clean.test[0], name="twin.png")
    scene = replace(clean, train=[*clean.train, twin], test=[filled(0)(view) for view in clean.test])
    assert left_out(scene) == []


def test_small_photos_without_points() -> None:
    """Nothing is told of photos below 32 px without points, but the very same photo twice is."""
    views = [
        replace(v, camera=replace(v.camera, width=20, height=20), image=v.image[:20, :20])
        for v in clean_scene().train
    ]
    none = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    assert left_out(Scene("small", views, [], *none, "test")) == []
    again = replace(views[3], name="again.png")
    assert left_out(Scene("small", [*views, again], [], *none, "test")) == ["again.png"]


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.0, 3.0])
def test_relative_blur_is_measured(sigma: float) -> None:
    views = [blurred(sigma)(view) if k == 3 else view for k, view in enumerate(clean_scene().train)]
    sharpness = Sharpness([look.rings for look in look_at_photos(views) if look.rings is not None])
    others = np.array([k for k in range(PHOTOS) if k != 3])
    assert sharpness.extra_blur(3, others) == pytest.approx(sigma, abs=0.5)


def test_sight() -> None:
    """Parallax by hand; a view from behind and one from far away do not stand in."""
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])

    def camera(x: float, z: float, turn: float = 0.0) -> View:
        R = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ [x, 0, z]
        return View("", Camera(100, 100, K, viewmat), np.zeros((100, 100, 3), np.uint8))

    points = np.array([[0, 0, 4], [0.5, 0, 4], [0, 0.5, 4], [30, 0, 4]], np.float32)
    views = [camera(0, 0), camera(0.01, 0), camera(0, 8, np.pi), camera(0, -5)]
    sight = Sight(views, points)
    np.testing.assert_array_equal(sight.covered(0).sum(1), [0, 3, 0, 0])
    np.testing.assert_array_equal(sight.covered(3).sum(1), [3, 3, 0, 0])
    near, moved = sight.same_place(0, np.array([1, 2, 3]), 0.5)
    np.testing.assert_array_equal(near, [1])
    np.testing.assert_allclose(moved, [100 * 0.01 / 4], atol=1e-6)
    assert len(sight.same_place(0, np.array([1, 2, 3]), 0.2)[0]) == 0
