"""Distances in the viewer: what a click meets, how far two of them are apart, and the bar."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hqgs.model.gaussians import Gaussians
from hqgs.scene.metres import point_of
from hqgs.scene.world import World
from hqgs.show.frames import Activated
from hqgs.show.viewer.measure import Point, picked, told_distance
from hqgs.show.viewer.viewer import Viewer

FAR = 4.0  # of the wall that is looked at, world units
METRE = World(0.5, metres=0.5)  # a world unit is 0.5 m


@pytest.fixture(scope="module")
def wall() -> Gaussians:
    """A dense wall of thin discs."""
    x, y = (part.ravel() for part in torch.meshgrid(*[torch.arange(-2, 2, 0.05)] * 2, indexing="ij"))
    count = len(x)
    made = Gaussians(
        means=torch.stack([x, y, torch.full((count,), FAR)], 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[-2.8, -2.8, -7.0]]).repeat(count, 1),
        opacities=torch.full((count,), 6.0),
        sh0=torch.zeros(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
    )
    made.world = METRE
    return made


def test_a_click_meets_the_surface_and_tells_its_error(wall: Gaussians) -> None:
    scene = Activated(wall)
    for direction in ([0, 0, 2.0], [0.3, -0.2, 1.0], [-0.25, 0.4, 1.0]):
        point = picked(scene, [0, 0, 0], direction)
        assert point is not None
        off = np.linalg.norm(point.at - FAR * np.array(direction) / direction[2])
        assert off < 3 * point.error < 0.1
        assert point.error > 0.99e-3 * FAR
    assert picked(scene, [0, 0, 0], [0, 0, -1.0]) is None
    assert picked(scene, [0, 0, 0], [3.0, 0, 1.0]) is None
    assert picked(scene, [0, 0, np.nan], [0, 0, 1.0]) is None
    assert picked(scene, [0, 0, 0], [0, 0, 0]) is None


def test_a_distance_has_the_errors_of_its_ends() -> None:
    a, b = Point(np.array([0, 0, 4.0]), 0.03), Point(np.array([2.0, 0, 4]), 0.04)
    ends = 1.96 * 0.5 * 0.05
    told = told_distance(a, b, METRE)
    assert told == f"1.000 ± {ends:.3f} m (95 %; without the error of the scale itself)"
    assert told_distance(a, b, World()).startswith(
        f"2.000 ± {2 * ends:.3f} units (95 %; the size of a unit is unknown"
    )


def test_two_clicks_on_the_page_tell_a_distance(wall: Gaussians) -> None:
    pytest.importorskip("viser")
    viewer = Viewer(None, None, port=0)
    try:
        viewer.set_scene(wall)
        ruler = viewer.ruler
        for x in (-0.25, 0.25):
            ruler.clicked(SimpleNamespace(ray_origin=(0.0, 0.0, 0.0), ray_direction=(x, 0.0, 1.0)))
        found = re.match(r"([\d.]+) ± ([\d.]+) m", ruler.told.content)
        assert found is not None
        assert float(found[1]) == pytest.approx(1.0, abs=0.01)  # two units of half a metre
        assert 0.02 <= float(found[2]) < 0.05
        points = re.search(r"`--distance (\S+) (\S+) METRES`", ruler.told.content)
        assert points is not None
        a, b = (point_of(text) for text in points.groups())
        assert a is not None
        assert b is not None
        assert np.linalg.norm(a - b) == pytest.approx(2.0, abs=0.02)  # of the files' units
        ruler.clicked(SimpleNamespace(ray_origin=(0.0, 0.0, 0.0), ray_direction=(0.0, 0.0, 1.0)))
        assert ruler.told.content == "Click the second point."
        ruler.clicked(SimpleNamespace(ray_origin=(0.0, 0.0, 0.0), ray_direction=(0.0, 0.0, -1.0)))
        assert ruler.told.content.startswith("No surface there")
    finally:
        viewer.close()
