"""What a notebook shows of a scene, a render and a run."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_ply import random_gaussians
from tiny_scene import tiny_config, tiny_scene

import hqgs


def shown(model: hqgs.Gaussians) -> np.ndarray:
    data = model._repr_png_()
    assert data is not None
    return np.asarray(Image.open(io.BytesIO(data)))


def test_a_scene_shows_itself_from_a_camera_of_its_run(tmp_path: Path) -> None:
    scene = tiny_scene()
    run = hqgs.train(scene, out=tmp_path, config=tiny_config())
    expected = np.asarray(hqgs.picture(run.model.render(scene.test[0].camera)))
    assert expected.std() > 5
    for model in (run.model, hqgs.Gaussians.load(tmp_path), hqgs.Gaussians.load(tmp_path / "scene.ply")):
        assert np.array_equal(shown(model), expected)
    html = run._repr_html_()
    assert html.count("data:image/jpeg;base64,") == 2
    assert "30 iterations" in html


def test_a_bare_scene_shows_itself_whole(tmp_path: Path) -> None:
    g = random_gaussians(200, 0)
    g.scales[:], g.sh0[:], g.opacities[:] = -2.0, 1.0, 2.0
    g.save(tmp_path / "other.ply")
    model = hqgs.Gaussians.load(tmp_path / "other.ply")
    assert model.look is None
    picture = shown(model)
    assert picture.shape == (378, 504, 3)
    assert picture[120:260, 170:330].mean() > picture[:40, :40].mean() + 10
    assert random_gaussians(0, 0)._repr_png_() is None


def test_a_scene_beside_damaged_cameras_loads_and_shows_itself_whole(tmp_path: Path) -> None:
    random_gaussians(20, 0).save(tmp_path / "scene.ply")
    (tmp_path / "cameras.json").write_text("{")
    model = hqgs.Gaussians.load(tmp_path / "scene.ply")
    assert (len(model), model.look) == (20, None)
    assert shown(model).shape == (378, 504, 3)


def test_pictures() -> None:
    image = torch.tensor([[[-1.0, 0.5, 2.0]]])
    assert hqgs.picture(image).getpixel((0, 0)) == (0, 128, 255)
    assert hqgs.picture(np.full((2, 3, 3), 7, np.uint8)).size == (3, 2)
    with pytest.raises(ValueError, match=r"image has shape \[3, 2\], wanted \[H, W, 3\]"):
        hqgs.picture(torch.zeros(3, 2))
