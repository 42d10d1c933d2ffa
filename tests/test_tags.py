"""`--tag-size METRES`: printed tags tell how large a scene is, and what is up in it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fixtures_scenes import make_truth, write_transforms
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hqgs
from hqgs.model.formats.gltf import upright
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.paths import look_at
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.tags import by_tags, check_tag_size

SIZE, UNIT = 0.08, 0.37  # m: of a tag, and of a unit of the scene
Q = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()  # from a world with y down to that of the scene
SAMPLES = 4  # rays of a pixel, each way


def photo(camera: Camera, tags: list[tuple[int, float, float, float]], seed: int) -> NDArray[np.uint8]:
    """A level plane with tags (number, x, z, turn in radians), in linear light, with noise of 3 levels."""
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    rows, columns = (np.mgrid[: camera.height * SAMPLES, : camera.width * SAMPLES] + 0.5) / SAMPLES
    rays = np.linalg.solve(camera.K, np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])).T
    rays = rays @ camera.viewmat[:3, :3] @ Q
    eye = camera.center @ Q
    x, _, z = (eye + rays * (-eye[1] / rays[:, 1])[:, None]).T
    light = 0.3 + 0.1 * np.sin(9 * x) * np.cos(7 * z)
    for number, middle_x, middle_z, turn in tags:
        bits = np.pad(cv2.aruco.generateImageMarker(codes, number, 8), 1, constant_values=255) / 255
        u, v = x - middle_x, middle_z - z
        u, v = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
        u, v = (np.floor(part / (SIZE / UNIT) * 8 + 5).astype(int) for part in (u, v))
        on = (np.minimum(u, v) >= 0) & (np.maximum(u, v) < 10)
        light[on] = 0.03 + 0.7 * bits[v[on], u[on]]
    mean = light.reshape(camera.height, SAMPLES, camera.width, SAMPLES).mean((1, 3))
    noise = np.random.default_rng(seed).normal(0, 3, mean.shape)
    return np.repeat(np.rint(255 * mean ** (1 / 2.2) + noise).clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def scene(tags: list[tuple[int, float, float, float]], views: int = 5) -> Scene:
    made = []
    for k in range(views):
        eye = Q @ [0.9 * np.sin(k), -1.3 - 0.2 * (k % 2), 0.9 * np.cos(2 * k)]
        camera = look_at(eye, Q @ [0.1, 0, 0], up=Q @ [0.1, -1.0, 0.1], width=320, height=240, fov=45)
        made.append(View(f"{k}.png", camera, photo(camera, tags, k)))
    return Scene("tags", made, [], np.zeros((4, 3), np.float32), np.zeros((4, 3), np.uint8), "made")


def test_scale_and_up_of_tags_that_lie_on_a_table(tmp_path: Path) -> None:
    tags = [(3, -0.25, 0.1, 0.2), (8, 0.3, -0.15, 1.2)]
    found = by_tags(scene(tags), SIZE)
    assert found.world.metres is not None
    assert found.world.error is not None
    assert found.world.metres == pytest.approx(UNIT, rel=5e-3)
    assert abs(found.world.metres / UNIT - 1) < 1.5 * found.world.error < 0.01
    assert found.world.up is not None
    up = Q @ [0, -1, 0]
    assert np.degrees(np.arccos(found.world.up @ up)) < 0.3
    assert "2 tags (APRILTAG_36h11 3, APRILTAG_36h11 8) of 0.08 m, in up to 5 photos" in found.notes[-1]
    save_cameras(tmp_path, found)
    np.testing.assert_allclose(load_cameras(tmp_path).up, found.world.up)
    np.testing.assert_allclose(
        upright(found.world.up).apply(np.array([1, -1, -1]) * found.world.up), [0, 1, 0], atol=1e-12
    )
    model = Gaussians.from_points(
        np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32), np.zeros((9, 3), np.uint8), 0
    )
    model.world = found.world
    for name in ("a.ply", "a.spz", "a.glb"):
        model.save(tmp_path / name)
        assert Gaussians.load(tmp_path / name).world == found.world


def test_a_number_that_lies_twice_tells_nothing() -> None:
    with pytest.raises(ValueError, match=r"tag_size: no tag tells .*APRILTAG_36h11 3 lies in several places"):
        by_tags(with_two_places(), SIZE)
    with pytest.raises(
        ValueError, match=r"0 numbers in 0 photos\): 3 photos and more must show the same one"
    ):
        by_tags(scene([(3, -0.25, 0.1, 0.2)], views=2), SIZE)


def with_two_places() -> Scene:
    """One number, here in some photos and there in others."""
    here, there = scene([(3, -0.25, 0.1, 0.2)]), scene([(3, 0.3, -0.15, 1.2)])
    return replace(here, train=[*here.train[:2], *there.train[2:]])


@pytest.mark.parametrize("size", [0.0, -0.1, float("nan"), float("inf")])
def test_a_size_that_can_be_none_is_told_before_the_photos_are_read(size: float, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"tag_size: .* m; it must be more than 0"):
        hqgs.load(tmp_path / "nowhere", tag_size=size)


def test_what_tags_need_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="only one of them can tell the metre"):
        hqgs.load(tmp_path, tag_size=0.1, distance=("a", "b", 2.0))
    with pytest.raises(ValueError, match="no tag tells a size"):
        hqgs.load(write_transforms(make_truth(), tmp_path), tag_size=0.1)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ValueError, match=r"pip install 'hqgs\[tags\]'"):
        check_tag_size(0.1)
