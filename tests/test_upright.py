"""Up in a scene, by edges of the built-in room."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.scenes.room.scene import embedded_cameras
from benchmarks.scenes.room.shading import render_view
from hqgs.scene.formats.colmap import write_colmap
from hqgs.scene.georeference import Georeference
from hqgs.scene.paths import scene_up
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.source import load
from hqgs.scene.upright import as_asked, direction_of, with_up

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
    points = np.random.default_rng(2).uniform([-1, -1, 2], [1, 1, 4], (8, 3))
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
    asked = as_asked(room, direction_of((0, 0, -2)))
    assert asked.world.up == (0, 0, -1)
    np.testing.assert_allclose(scene_up(asked), [0, 0, -1])
    assert asked.notes[-1] == "up is (0.000, 0.000, -1.000), as given"
    for wrong in ((0, 0, 0), (1, 2), (math.nan, 0, 1)):
        with pytest.raises(ValueError, match=r"up is .*, wanted three numbers"):
            direction_of(wrong)
