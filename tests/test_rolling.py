"""Photos whose rows were taken one after another: the operator, how it is told, and what is learned of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from test_learned_cameras import MARGIN, SIZE, assert_same, learned_config, run, tensors, textured_scene
from tiny_scene import tiny_scene

import hqgs
from hqgs.diagnosis.own import rolling_finding
from hqgs.diagnosis.rolling import rolling_signs
from hqgs.photos.exposure import take_photo, take_rows
from hqgs.scene.scene import Scene
from hqgs.training.methods.cameras import LearnedCameras
from hqgs.training.methods.rolling import LearnedRolling
from hqgs.training.trainer import Trainer


def slid(scene: Scene, slides: NDArray[np.float64]) -> Scene:
    """Each photo slides by [2], right and down in shares of its height, from its top to its bottom."""
    train = []
    for view, (right, down) in zip(scene.train, slides, strict=True):
        height, width = view.image.shape[:2]
        y, x = np.indices((height, width), np.float64)
        t = (y + 0.5) / height - 0.5
        at = [y - down * height * t, x - right * height * t]
        photo = np.stack(
            [map_coordinates(c, at, order=1, mode="nearest") for c in view.image.T.swapaxes(1, 2)], -1
        )
        train.append(replace(view, image=photo))
    return replace(scene, train=train)


def drawn_slides(scene: Scene, size: float = 0.02) -> NDArray[np.float64]:
    drawn = size * np.random.default_rng(2).normal(size=(len(scene.train), 2))
    return drawn - drawn.mean(0)


@pytest.mark.parametrize("count", [0, 3])
def test_each_band_of_rows_is_that_of_a_photo_with_its_warp(count: int) -> None:
    """Values and gradients; bands of unequal heights, and more of them than rows."""
    image, near, warps, gains = tensors(count)
    warps = warps / 4  # within the margin
    weights = torch.randn((*SIZE, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for bands in (4, 20):
        rows = tensors(bands)[2] / 4
        found: list[list[torch.Tensor]] = []
        edges = np.linspace(0, SIZE[0], bands + 1).round().astype(int)
        for whole in (False, True):
            given = [t.clone().requires_grad_() for t in (image, warps, gains, rows)]
            a, w, g, r = given
            if whole:
                parts = [
                    take_photo(a, SIZE, near, w + row if count else row[None], g)[top:end]
                    for row, top, end in zip(r, edges[:-1], edges[1:], strict=True)
                ]
                taken = torch.cat(parts)
            else:
                taken = take_rows(a, SIZE, near, w, g, r)
            (taken * weights).sum().backward()
            found.append([taken.detach(), *(t.grad if t.grad is not None else t for t in given)])
        for part, expected in zip(*found, strict=True):
            np.testing.assert_allclose(part.detach(), expected.detach(), atol=1e-9)


def test_slides_are_told_and_where_there_are_none_nothing_is() -> None:
    scene = textured_scene()
    truth = drawn_slides(scene)
    signs, straight = rolling_signs(slid(scene, truth)), rolling_signs(scene)
    assert signs is not None
    assert straight is not None
    assert np.corrcoef(signs.slides.ravel(), truth.ravel())[0, 1] > 0.95
    reasons = [rolling_finding(each).reason for each in (signs, straight, None)]
    assert ["--formation rolling" in reason for reason in reasons] == [True, False, False]
    assert rolling_signs(replace(scene, seen=None)) is None
    assert rolling_signs(replace(scene, seen={v.name: np.arange(2) for v in scene.train})) is None
    assert rolling_signs(replace(scene, train=scene.train[:2])) is None


def test_what_is_learned_makes_a_straight_render_the_photo() -> None:
    scene = tiny_scene()
    view = scene.train[1]
    height, width = view.image.shape[:2]
    slide = np.array([0.1, -0.05])
    rolling = LearnedRolling(scene.train)
    cameras = LearnedCameras(scene, False, False, None, 0, rolling=rolling)
    right, down = slide * height
    with torch.no_grad():
        rolling.param_groups()[0]["params"][1][0, :2] = torch.tensor([down, -right])
    np.testing.assert_allclose(cameras.learned()[1].rolling, [right, down], rtol=1e-6)
    np.testing.assert_array_equal(cameras.learned()[0].rolling, 0)
    shot = cameras.shot(view, torch.from_numpy(view.image))
    margin = (shot.camera.height - height) // 2

    def picture(x: NDArray[np.float64], y: NDArray[np.float64]) -> torch.Tensor:
        waves = [np.sin(0.4 * x + 0.2 * y), np.cos(0.3 * y), np.sin(0.3 * y - 0.3 * x)]
        return torch.from_numpy(0.5 + 0.3 * np.stack(waves, -1))

    y, x = np.indices((height + 2 * margin, width + 2 * margin)) - margin + 0.5
    taken = shot.develop(picture(x, y))
    y, x = np.indices((height, width)) + 0.5
    t = y / height - 0.5
    photo = picture(x - right * t, y - down * t)
    inside = slice(MARGIN, -MARGIN)
    off = (taken - photo)[inside, inside].square().mean().sqrt()
    assert off < 0.5 * (picture(x, y) - photo)[inside, inside].square().mean().sqrt()


def test_a_resumed_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    scene, formation = slid(tiny_scene(), drawn_slides(tiny_scene())), "rolling+shake"
    whole = run(scene, formation)
    half = Trainer(scene, learned_config(formation))
    while half.iteration < 17:
        half.step()
    half.save(tmp_path / "checkpoint.safetensors")
    rest = Trainer(scene, learned_config(formation))
    rest.restore(tmp_path / "checkpoint.safetensors")
    while rest.iteration < rest.length:
        rest.step()
    assert_same(whole, rest)
    assert max(float(np.abs(photo.rolling).max()) for photo in rest.method.learned()) > 0


def test_photos_are_not_made_so() -> None:
    with pytest.raises(ValueError, match="true-rolling"):
        hqgs.degrade(tiny_scene(), "rolling")
