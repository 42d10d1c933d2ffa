"""First points that photos find back in each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_learned_cameras import textured_scene

import hqgs
from hqgs.model.consistency import Agreement
from hqgs.model.first_points import points_along_edges
from hqgs.scene.scene import View

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
