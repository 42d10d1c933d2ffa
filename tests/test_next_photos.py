"""Where to photograph next: gaps, loose poses, what few photos show; in words, and the report's picture."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from hqgs.scene.next_photos import next_photos, told_next
from hqgs.scene.paths import look_at
from hqgs.scene.scene import Scene, SfmReport, View
from hqgs.show.page.charts import places_chart

UP = np.array([0.1, -1.0, 0.05]) / np.linalg.norm([0.1, -1.0, 0.05])


def ring(degrees: list[float]) -> Scene:
    """Photos from a circle around the origin, turned by these angles, that look at its middle."""
    first = np.cross(UP, [0.0, 0, 1])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(UP, first)])
    views = []
    for k, angle in enumerate(np.radians(degrees)):
        eye = 3 * (np.cos(angle) * plane[0] + np.sin(angle) * plane[1]) + 0.5 * UP
        camera = look_at(eye, [0, 0, 0], up=UP, width=8, height=8)
        views.append(View(f"{k:02}.jpg", camera, np.zeros((8, 8, 3), np.uint8)))
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3)).astype(np.float32)
    seen = {view.name: np.arange(60) for view in views}
    return Scene("ring", views, [], points, np.zeros((60, 3), np.uint8), "photos", seen=seen)


def test_a_gap_in_a_ring_is_found_and_where_it_is() -> None:
    scene = ring([*range(0, 150, 15), *range(240, 360, 15)])
    (spot,) = next_photos(scene)
    assert re.fullmatch(r"between 09.jpg and 10.jpg, which are 10[3-7] degrees apart", spot.told)
    a, b = (scene.train[k].camera.center for k in (9, 10))
    assert np.linalg.norm(spot.at - a) == pytest.approx(np.linalg.norm(spot.at - b), rel=0.05)
    assert np.linalg.norm(spot.at - 0.5 * UP) == pytest.approx(3, rel=0.05)
    assert told_next(scene) == [f"photograph here next: {spot.told}"]


@pytest.mark.parametrize("degrees", [[*range(0, 360, 15)], [*range(0, 160, 8)], [0.0, 90, 180, 270]])
def test_an_even_ring_and_a_capture_of_one_side_ask_for_nothing(degrees: list[float]) -> None:
    assert told_next(ring(degrees)) == []


def test_neighbours_that_look_the_same_way_have_no_gap_between_them() -> None:
    """They walk by what the others look at."""
    scene = ring([*range(0, 150, 15), *range(240, 360, 15)])
    train = list(scene.train)
    for k in (9, 10):
        eye = train[k].camera.center
        camera = look_at(eye, eye + np.array([5.0, 0, 1]), up=UP, width=8, height=8)
        train[k] = replace(train[k], camera=camera)
    assert told_next(replace(scene, train=train)) == []


def test_loose_poses_and_what_one_other_photo_shows_are_told() -> None:
    scene = ring([*range(0, 360, 15)])
    sure = {view.name: 0.2 for view in scene.train} | {"07.jpg": 2.5}
    report = SfmReport(24, [], 60, 3.0, 0.5, sure_px=sure)
    seen = {name: rows[:40] for name, rows in (scene.seen or {}).items()} | {"11.jpg": np.arange(30, 60)}
    scene = replace(scene, sfm=report, seen=seen)
    loose, alone = next_photos(scene)
    assert loose.told == "beside 07.jpg, whose place is sure to 2.5 px only"
    np.testing.assert_array_equal(loose.at, scene.train[7].camera.center)
    assert alone.told == "beside 11.jpg: 67% of what it shows is in one other photo at most"
    chart = places_chart(scene, next_photos(scene))
    assert chart is not None
    assert len(re.findall(r"<g stroke", chart)) == 24
    assert "07.jpg: sure to 2.50 px" in chart
    assert chart.count('stroke="#c03030"') == 2
    assert re.findall(r'font-size="11">(.*?)<', chart) == ["07.jpg", "11.jpg"]
    assert len(re.findall(r'<g stroke="#d0672a"', chart)) == 1


def test_names_are_escaped_in_the_picture() -> None:
    scene = ring([0, 20, 40])
    scene = replace(scene, train=[replace(scene.train[0], name="<b>.jpg"), *scene.train[1:]])
    chart = places_chart(scene, next_photos(scene))
    assert chart is not None
    assert "<b>" not in chart
    assert places_chart(replace(scene, train=scene.train[:1]), []) is None
