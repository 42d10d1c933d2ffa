"""Photos of cut-out objects: what is transparent is empty, before any colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fixtures_scenes import make_truth, write_colmap
from PIL import Image

import hqgs
from hqgs.model.gaussians import Gaussians
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene


@pytest.fixture(scope="module")
def dark(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Photos of a nearly black ball before nothing, and as many points where nothing is."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    around = rng.uniform(-2, 2, (300, 3))  # of no use: nothing is there
    around = around[np.linalg.norm(around, axis=1) > 1.2]
    truth, root = make_truth(), tmp_path_factory.mktemp("dark")
    both = np.concatenate([points, around])
    truth = replace(truth, points=both, colors=np.full(both.shape, 5, np.uint8))
    write_colmap(truth, root, binary=False)
    scene = load_scene(root, test_every=0)
    ball = Gaussians.from_points(scene.points[:300], scene.point_colors[:300], 0)
    ball = replace(ball, opacities=ball.opacities + 6)
    for view in scene.train:
        with torch.no_grad():
            shown, lit = (ball.render(view.camera, background=(c, c, c)).numpy() for c in (0.0, 1.0))
        alpha = (1 - (lit - shown).mean(-1)).clip(0, 1)
        rgb = shown / np.maximum(alpha, 1e-3)[..., None]
        pixels = np.rint(255 * np.dstack([rgb.clip(0, 1), alpha])).astype(np.uint8)
        Image.fromarray(pixels).save(root / "images" / view.name)
    return hqgs.load(root, test_every=0)


@pytest.mark.parametrize("method", ["3dgs", "hqgs"])
def test_a_dark_object_is_there_before_a_bright_background(dark: Scene, method: str) -> None:
    """Before black alone nothing would tell it from nothing."""
    run = hqgs.train(dark, iterations=150, method=method, seed=0, leave_out="none")
    inside, outside = [], []
    for view in dark.train:
        assert view.empty is not None
        with torch.no_grad():
            shown = run.model.render(view.camera, background=(1, 1, 1)).numpy().mean(-1)
        inside.append(shown[view.empty == 0].mean())
        outside.append(shown[view.empty == 255].mean())
    assert np.mean(inside) < 0.05
    assert np.mean(outside) > 0.95
    assert len(run.model) < 3000  # before such colours gradients are large, and count for no growth
