"""Where the colours are read that tell the gains of photos."""

from __future__ import annotations

import numpy as np
import pytest

from hqgs.diagnosis import colors as gains
from hqgs.photos.light import to_srgb
from hqgs.scene.scene import Camera, View


@pytest.mark.parametrize(("x", "y"), [(20.5, 9.5), (7.5, 13.5), (16.0, 11.25)])
def test_a_points_colour_is_that_of_its_own_pixels(x: float, y: float) -> None:
    """A photo whose light rises with x and, faster, with y; pixels' centres lie at halves."""
    width, height, focal = 40, 24, 30.0
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    rows, columns = np.mgrid[:height, :width] + 0.5
    light = (0.1 + 0.005 * columns + 0.015 * rows)[..., None] * np.array([1.0, 0.9, 0.8])
    view = View("ramp.png", Camera(width, height, K, np.eye(4)), to_srgb(light.astype(np.float32)))
    depth = 2.0
    points = np.array([[(x - width / 2) * depth / focal, (y - height / 2) * depth / focal, depth]])
    colors = np.full((3, 3), np.nan)
    squares = np.full(3, np.nan)
    gains._note_colors(view, points, np.array([1]), colors, squares)  # pyright: ignore[reportPrivateUsage]
    expected = (0.1 + 0.005 * x + 0.015 * y) * np.array([1.0, 0.9, 0.8])
    np.testing.assert_allclose(colors[1], expected, rtol=1e-4)
    assert np.isnan(colors[[0, 2]]).all()
    away = (x - width / 2) ** 2 + (y - height / 2) ** 2  # half the diagonal is 1
    np.testing.assert_allclose(squares[1], away / (width**2 + height**2) * 4)
