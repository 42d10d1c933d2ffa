"""A transforms.json whose cameras have OpenCV's axes is noticed by matches between its photos."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image

import hqgs
from benchmarks.scenes.room.shading import render_view
from benchmarks.scenes.sparse import sparse_cameras
from hqgs.scene.axes import TURNED, with_true_axes
from hqgs.scene.capture import Capture, Photo, no_points
from hqgs.scene.scene import View


@cache
def views() -> tuple[View, ...]:
    """Photos of the room by neighbours on its arc."""
    cameras = sparse_cameras(200, 150, 25)[9:13]
    return tuple(View(f"view_{k}.png", camera, render_view(camera)) for k, camera in enumerate(cameras))


@pytest.mark.parametrize("opencv", [False, True])
def test_axes_of_transforms_json(opencv: bool, tmp_path: Path) -> None:
    frames = []
    for view in views():
        Image.fromarray(np.asarray(view.image)).save(tmp_path / view.name)
        pose = np.linalg.inv(view.camera.viewmat) @ (np.eye(4) if opencv else TURNED)
        frames.append({"file_path": view.name, "transform_matrix": pose.tolist()})
    camera = views()[0].camera
    K = {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    content = {"w": camera.width, "h": camera.height, **K, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = hqgs.load(tmp_path, test_every=0)
    for view, truth in zip(scene.train, views(), strict=True):
        np.testing.assert_allclose(view.camera.viewmat, truth.camera.viewmat, atol=1e-9)
    said = [note for note in scene.notes if "y and z axes were flipped" in note]
    assert len(said) == opencv


def capture_of(views: Sequence[View], points: NDArray[np.float64], colors: NDArray[np.uint8]) -> Capture:
    """As a reader of transforms.json hands it over."""
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1, 0.5, 0.5])
    photos = [Photo(view.name, Path(view.name), camera, view.camera.viewmat) for view in views]
    return Capture("transforms", photos, 1.0, points, colors)


@pytest.mark.parametrize("inverse", [False, True])
def test_inverse_poses_of_photos_side_by_side(inverse: bool) -> None:
    """Their epipolar lines are those of the right poses; what the photos show is behind the cameras."""
    first, moves = sparse_cameras(200, 150, 25)[10], np.stack([np.eye(4)] * 4)
    moves[:, 0, 3] = [0.0, -0.15, -0.3, -0.45]
    stored = []
    for k, move in enumerate(moves):
        said = replace(first, viewmat=np.linalg.inv(move) if inverse else move)
        stored.append(View(f"{k}.png", said, render_view(replace(first, viewmat=move @ first.viewmat))))
    capture, told = with_true_axes(replace(capture_of(stored, *no_points()), source="colmap"), stored)
    for photo, move in zip(capture.photos, moves, strict=True):
        np.testing.assert_allclose(photo.viewmat, move, atol=1e-9)
    assert (told is not None) == inverse
    assert told is None or "poses are read as camera to world" in told


def test_photos_that_do_not_match_tell_nothing() -> None:
    rng = np.random.default_rng(0)
    noise = [
        View(view.name, view.camera, rng.integers(0, 256, view.image.shape, dtype=np.uint8))
        for view in views()
    ]
    for some in (noise, [], noise[:1]):
        capture = capture_of(some, *no_points())
        assert with_true_axes(capture, some) == (capture, None)
