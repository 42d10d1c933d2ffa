"""Depths that other photos agree with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from test_learned_cameras import textured_scene

from hqgs.model.consistency import Agreement
from hqgs.scene.geometry import project, unproject
from hqgs.scene.scene import View


def test_the_surface_is_found_within_the_ranges() -> None:
    scene = textured_scene(8, 96)
    assert scene.seen is not None
    views = scene.train
    rng = np.random.default_rng(0)
    pixels = rng.integers(20, 76, (200, 2)).astype(np.float64) + 0.5
    nearest = rng.uniform(0.6, 0.95, 200)  # the plane is at depth 1
    ranges = np.stack([nearest, rng.uniform(1.05, 1.6, 200)], axis=1)
    depths, agreed = Agreement(views, scene.seen).depths(3, pixels, ranges)
    assert agreed.mean() > 0.9
    points = unproject(views[3].camera, pixels[agreed], depths[agreed])
    found, true = (project(views[0].camera, p)[0] for p in (points, on_plane(views[3], pixels[agreed])))
    assert np.median(np.abs(found - true)) < 0.5  # px


def on_plane(view: View, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    return unproject(view.camera, pixels, np.ones(len(pixels)))


def test_flat_and_contradicting_photos_do_not_agree() -> None:
    scene = textured_scene(8, 96)
    assert scene.seen is not None
    pixels = np.random.default_rng(0).integers(20, 76, (100, 2)).astype(np.float64) + 0.5
    ranges = np.tile([0.7, 1.5], (100, 1))
    flat = [replace(view, image=np.full_like(view.image, 128)) for view in scene.train]
    assert not Agreement(flat, scene.seen).depths(3, pixels, ranges)[1].any()
    rng = np.random.default_rng(1)
    noise = [replace(v, image=rng.integers(0, 256, v.image.shape).astype(np.uint8)) for v in scene.train]
    assert Agreement(noise, scene.seen).depths(3, pixels, ranges)[1].mean() < 0.2
    assert not Agreement(scene.train[:2], scene.seen).depths(0, pixels, ranges)[1].any()
    assert Agreement(scene.train, {}).depths(0, pixels, ranges)[0].shape == (
        100,
    )  # what they see is not known
