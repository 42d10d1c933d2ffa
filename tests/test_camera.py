"""Points into a camera and back."""

import tracemalloc
import warnings

import numpy as np
import pytest
from tiny_scene import tiny_scene

from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import Camera, Scene

# The camera stands at (1, 2, 3) and looks along world x: its right is -y, its down is -z.
LOOKS_ALONG_X = np.array([[0, -1, 0, 2], [0, 0, -1, 3], [1, 0, 0, -1], [0, 0, 0, 1]], dtype=np.float64)


@pytest.fixture
def camera():
    return Camera(64, 48, np.array([[50.0, 0, 30], [0, 40, 20], [0, 0, 1]]), LOOKS_ALONG_X)


def test_a_point_worked_out_by_hand(camera):
    pixels, depths = project(camera, np.array([[5.0, 1.0, 4.0]]))  # 4 ahead, 1 to the right, 1 up
    np.testing.assert_allclose(depths, [4])
    np.testing.assert_allclose(pixels, [[30 + 50 / 4, 20 - 40 / 4]])


def test_unproject_is_the_way_back(camera):
    rng = np.random.default_rng(0)
    pixels, depths = rng.uniform(-20, 90, (100, 2)), rng.uniform(0.01, 1e4, 100)
    again, same = project(camera, unproject(camera, pixels, depths))
    np.testing.assert_allclose(again, pixels, atol=1e-8)
    np.testing.assert_allclose(same, depths, rtol=1e-9, atol=1e-12)


def test_points_beside_and_behind_are_told_by_their_depths(camera):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pixels, depths = project(camera, np.array([[1.0, 1.0, 1.0], [0.0, 2.0, 3.0]]))
    np.testing.assert_array_equal(depths, [0, -1])
    assert not np.isfinite(pixels[0]).any()
    assert project(camera, np.zeros((0, 3)))[0].shape == (0, 2)


def test_the_reach_of_a_large_scene_takes_little_memory() -> None:
    view, rng = tiny_scene().train[0], np.random.default_rng(0)
    points = rng.normal([0, 0, 5], 1, (400_000, 3)).astype(np.float32)
    scene = Scene("many", [view] * 60, [], points, np.zeros((400_000, 3), np.uint8), "test")
    tracemalloc.start()
    reach = scene.reach
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6  # 672 MB if each view kept the depths of all points
    depths = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
    assert reach == pytest.approx(np.median(depths[depths > 0]), rel=0.01)
