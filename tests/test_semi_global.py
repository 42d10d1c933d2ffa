"""Depths of all pixels, smooth where other photos tell nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates
from test_learned_cameras import textured_scene

from hqgs.model.consistency import SmallPhoto, pixel_map
from hqgs.model.constants import ACROSS_EDGES, JUMP, LAYERS, SLOPE
from hqgs.model.semi_global import DenseDepths, _along, _smoothed, depths_of

VIEWS = textured_scene(8, 96).train[:4]  # a plane at depth 1 of the first camera
BOUNDS = np.array([0.5, 2.5])


def test_paths_cost_what_the_recurrence_says() -> None:
    rng = np.random.default_rng(0)
    costs, grey = rng.random((4, 3, 5)).astype(np.float32), rng.random((4, 3)).astype(np.float32)
    expected = costs.astype(np.float64)
    for row, column in np.ndindex(3, 3):
        before = expected[row, column]
        step = abs(float(grey[row + 1, column]) - float(grey[row, column]))
        jump = max(JUMP / (1 + ACROSS_EDGES * step), SLOPE)
        for layer in range(5):
            beside = [before[near] + SLOPE for near in (layer - 1, layer + 1) if 0 <= near < 5]
            least = min([before[layer], *beside, before.min() + jump])
            expected[row + 1, column, layer] += least - before.min()
    np.testing.assert_allclose(_along(costs, grey), expected, rtol=1e-5)
    # Four paths: a picture on its side or upside down has the same costs.
    all_four = _smoothed(costs, grey)
    np.testing.assert_allclose(_smoothed(costs.swapaxes(0, 1), grey.T), all_four.swapaxes(0, 1), rtol=1e-5)
    np.testing.assert_allclose(_smoothed(costs[::-1], grey[::-1]), all_four[::-1], rtol=1e-5)


def test_a_plane_is_found_and_what_is_flat_lies_between_its_surroundings() -> None:
    blank = []
    for view in VIEWS:
        image = view.image.copy()
        image[40:52, 40:52] = 128
        blank.append(SmallPhoto.of(replace(view, image=image)))
    for looks in ([SmallPhoto.of(view) for view in VIEWS], blank):
        depths, alike = depths_of(looks[0], looks[1:], BOUNDS)
        assert depths.shape == alike.shape == looks[0].grey.shape
        layer = (1 / BOUNDS[0] - 1 / BOUNDS[1]) / (LAYERS - 1)  # of nearness, 1 here
        inner = np.abs(1 / depths[8:-8, 8:-8] - 1)
        assert np.mean(inner < layer) > 0.9
    assert np.median(alike[8:-8, 8:-8]) > 0.8


def test_what_no_other_photo_bears_out_does_not_stand() -> None:
    looks = [SmallPhoto.of(view) for view in VIEWS]
    everyone = [[j for j in range(4) if j != k] for k in range(4)]
    pixels = np.random.default_rng(0).uniform(10, 80, (200, 2))
    _, stands = DenseDepths(looks, everyone, [BOUNDS] * 4).at(0, pixels)
    assert stands.mean() > 0.9
    rng = np.random.default_rng(1)
    noise = [looks[0], *(replace(look, grey=rng.random(look.grey.shape, np.float32)) for look in looks[1:])]
    _, stands = DenseDepths(noise, everyone, [BOUNDS] * 4).at(0, pixels)
    assert stands.mean() < 0.3


def test_masked_pixels_are_compared_with_nothing() -> None:
    """Someone who walks along looks alike in two photos, at a depth that is not the scene's."""
    looks = [SmallPhoto.of(view) for view in VIEWS]
    high, wide = looks[3].grey.shape
    x, y = np.meshgrid(np.arange(wide) + 0.5, np.arange(high) + 0.5)
    m = pixel_map(looks[3].camera, looks[0].camera)
    to_x, to_y, w = (row[0] * x + row[1] * y + row[2] + row[3] * 1.6 for row in m)
    walked = map_coordinates(looks[0].grey, [to_y / w - 0.5, to_x / w - 0.5], order=1, mode="nearest")
    seen = np.ones((high, wide), bool)
    seen[20:70, 20:70] = False
    passing = replace(looks[3], grey=np.where(seen, looks[3].grey, walked))
    off = []
    for other in (passing, replace(passing, mask=seen)):
        depths, _ = depths_of(looks[0], [other], BOUNDS)
        off.append(np.abs(1 / depths - 1)[30:60, 30:60])
    assert np.median(off[0]) > 0.4
    assert np.median(off[1]) < 0.1
    everyone = [[j for j in range(4) if j != k] for k in range(4)]
    hidden = [looks[0], *(replace(look, mask=np.zeros_like(seen)) for look in looks[1:])]
    _, stands = DenseDepths(hidden, everyone, [BOUNDS] * 4).at(0, np.full((1, 2), 48.0))
    assert not stands.any()
