"""The report's picture of the cameras from above."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from hqgs.scene.paths import look_at
from hqgs.scene.scene import Scene, SfmReport, View
from hqgs.show.page.charts import places_chart

UP = np.array([0.1, -1.0, 0.05]) / np.linalg.norm([0.1, -1.0, 0.05])


def ring(degrees: list[float]) -> Scene:
    """Photos from a circle around the origin, turned by these angles, that look at its middle."""
    first = np.cross(UP, [0.0, 0, 1])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(UP, first)])
    views = []
    for k, angle in enumerate(np.radians(degrees)):
        eye = 3 * (np.cos(angle) * plane[0] + np.sin(angle) * plane[1]) + 0.5 * UP
        camera = look_at(eye, [0, 0, 0], up=UP, width=8, height=8)
        views.append(View(f"{k:02}.jpg", camera, np.zeros((8, 8, 3), np.uint8)))
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3)).astype(np.float32)
    seen = {view.name: np.arange(60) for view in views}
    return Scene("ring", views, [], points, np.zeros((60, 3), np.uint8), "photos", seen=seen)


def test_each_camera_is_drawn_and_loose_ones_are_marked() -> None:
    scene = ring([*range(0, 360, 15)])
    sure = {view.name: 0.2 for view in scene.train} | {"07.jpg": 2.5}
    chart = places_chart(replace(scene, sfm=SfmReport(24, [], 60, 3.0, 0.5, sure_px=sure)))
    assert chart is not None
    assert len(re.findall(r"<g stroke", chart)) == 24
    assert len(re.findall(r'<g stroke="#d0672a"', chart)) == 1
    assert "07.jpg: exact to 2.50 px" in chart


def test_names_are_escaped_in_the_picture() -> None:
    scene = ring([0, 20, 40])
    scene = replace(scene, train=[replace(scene.train[0], name="<b>.jpg"), *scene.train[1:]])
    chart = places_chart(scene)
    assert chart is not None
    assert "<b>" not in chart
    assert places_chart(replace(scene, train=scene.train[:1])) is None
