"""Which training photos are left out: pictures of a plane, ray-cast, among them blurred and empty ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hqgs.diagnosis.choice import Sight, choose_photos
from hqgs.diagnosis.differences import Sharpness, summarised
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
    assert all(entry.why and entry.evidence for entry in out)
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
    assert note.startswith("these blurred training photos are used, as fewer than 3 sharper ones see")
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


@pytest.mark.parametrize("value", [0, 255, 100])
def test_empty_photos_go(value: int) -> None:
    scene = changed(clean_scene(), filled(value), 1, 4, 7)
    assert left_out(scene) == ["01.png", "04.png", "07.png"]
    entry = choose_photos(scene)[1][0]
    assert entry.why == "of one colour only"
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


def test_the_same_photo_twice_stays() -> None:
    clean = clean_scene()
    assert left_out(replace(clean, train=[*clean.train, replace(clean.train[4], name="again.png")])) == []


def test_at_least_half_and_three_stay() -> None:
    """Of eight photos five hold NaN, of which four can go; of four, one can; of three, none."""
    clean = clean_scene()

    def spoil(view: View) -> View:
        return replace(view, image=np.full(view.image.shape, np.nan, np.float32))

    scene = changed(replace(clean, train=clean.train[:8]), spoil, *range(5))
    chosen, out = choose_photos(scene)
    assert len(chosen.train) == len(out) == 4
    assert (
        chosen.notes[-1]
        == "these bad training photos are used, so that at least half of the photos stay: 04.png"
    )
    for count, gone in ((4, 1), (3, 0), (1, 0)):
        few = changed(replace(clean, train=clean.train[:count]), spoil, *range(count))
        assert len(left_out(few)) == gone


def test_worst_go_first_where_not_all_can() -> None:
    """Of eight photos: three empty and two blurred; four can go."""
    clean = clean_scene()
    scene = changed(replace(clean, train=clean.train[:8]), filled(0), 4, 6)
    scene = changed(scene, blurred(4), 5)
    assert left_out(scene) == ["04.png", "06.png", "05.png"]


def test_small_photos_without_points() -> None:
    """Nothing is told of photos below 32 px without points."""
    views = [
        replace(v, camera=replace(v.camera, width=20, height=20), image=v.image[:20, :20])
        for v in clean_scene().train
    ]
    none = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    assert left_out(Scene("small", views, [], *none, "test")) == []


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.0, 3.0])
def test_relative_blur_is_measured(sigma: float) -> None:
    views = [blurred(sigma)(view) if k == 3 else view for k, view in enumerate(clean_scene().train)]
    sharpness = Sharpness([look.rings for look in summarised(views) if look.rings is not None])
    others = np.array([k for k in range(PHOTOS) if k != 3])
    assert sharpness.extra_blur(3, others) == pytest.approx(sigma, abs=0.5)


def test_sight() -> None:
    """A view from behind does not stand in; one that is far away does."""
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])

    def camera(x: float, z: float, turn: float = 0.0) -> View:
        R = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ [x, 0, z]
        return View("", Camera(100, 100, K, viewmat), np.zeros((100, 100, 3), np.uint8))

    points = np.array([[0, 0, 4], [0.5, 0, 4], [0, 0.5, 4], [30, 0, 4]], np.float32)
    sight = Sight([camera(0, 0), camera(0.01, 0), camera(0, 8, np.pi), camera(0, -5)], points)
    np.testing.assert_array_equal(sight.covered(0).sum(1), [0, 3, 0, 3])
    np.testing.assert_array_equal(sight.covered(3).sum(1), [3, 3, 0, 0])
