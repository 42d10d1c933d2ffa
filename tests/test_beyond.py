"""Few photos: the room judged beyond its cameras, and the split of the papers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.protocol import fewer_photos
from benchmarks.scenes.rooms import room
from benchmarks.scenes.sparse import BETWEEN, BEYOND, TABLE, between_and_beyond, sparse_cameras
from hqgs.scene.scene import Scene, View


def test_held_out_cameras_stand_between_and_beyond() -> None:
    def angle(center: np.ndarray) -> float:
        return math.degrees(math.atan2(center[0] - TABLE[0], TABLE[2] - center[2]))

    train = [angle(camera.center) for camera in sparse_cameras(num_views=12, seed=7)]
    held = between_and_beyond()
    between = [angle(camera.center) for camera in held[:BETWEEN]]
    assert len(held) == BETWEEN + BEYOND
    assert min(train) < min(between) < max(between) < max(train)
    outside = [camera for camera in held[BETWEEN:] if not min(train) < angle(camera.center) < max(train)]
    distances = [float(np.linalg.norm((camera.center - TABLE)[[0, 2]])) for camera in held[BETWEEN:]]
    heights = [float(camera.center[1]) for camera in held[BETWEEN:]]
    assert len(outside) == 2
    assert sum(distance < 2.5 for distance in distances) == 2
    assert sum(y < -1.1 for y in heights) == 2
    np.testing.assert_array_equal(held[0].viewmat, between_and_beyond()[0].viewmat)


def test_the_room_beyond_its_cameras(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="wanted beyond:N with the number of photos, got 'x'"):
        room("beyond:x")
    with pytest.raises(ValueError, match="photos is 1, wanted at least 2"):
        room("beyond:1")
    scene = room("beyond:3", tmp_path, 16)
    assert (scene.name, len(scene.train), len(scene.test)) == ("beyond-3", 3, BETWEEN + BEYOND)
    assert {view.name.partition("_")[0] for view in scene.test} == {"between", "beyond"}
    again = room("beyond:3", tmp_path, 16)
    np.testing.assert_array_equal(again.test[-1].image, scene.test[-1].image)


def test_the_split_of_few_photos() -> None:
    camera, photo = sparse_cameras(8, 6, 2)[0], np.zeros((6, 8, 3), np.uint8)
    views = [View(f"view_{k:02d}.png", camera, photo) for k in range(16)]
    names = [view.name for view in views[2:]]
    seen = {name: np.arange(k, k + 4) for k, name in enumerate(names)}
    points = np.zeros((40, 3), np.float32), np.zeros((40, 3), np.uint8)
    scene = Scene("made", views[2:], views[:2], *points, "made", seen=seen)
    few = fewer_photos(scene, 3)
    last = len(names) - 1
    assert [view.name for view in few.train] == [names[0], names[round(last / 2)], names[last]]
    assert few.name.endswith("-3")
    assert [view.name for view in few.test] == [view.name for view in scene.test]
    assert len(few.points) == 0  # no point is seen by two of them
    near = fewer_photos(replace(scene, seen=dict.fromkeys(names, np.arange(5, 9))), 2)
    assert len(near.points) == 4
    np.testing.assert_array_equal(near.seen[names[0]] if near.seen else [], np.arange(4))
    with pytest.raises(ValueError, match="photos is 1, wanted 2 to"):
        fewer_photos(scene, 1)
