"""How long things are: the distance of two clicked points, with its error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.scene.paths import view_matrix
from hqgs.scene.scene import Camera
from hqgs.scene.world import World
from hqgs.show.frames import Activated

CLICKED = 3  # px a side, of the little picture around a click
CLICK_ERROR = 1e-3  # radians: what a click is off


@dataclass(frozen=True)
class Point:
    """A point of the scene under a pixel."""

    at: NDArray[np.float64]  # [3], world units
    error: float  # standard deviation, world units


def picked(scene: Activated, origin: Sequence[float], direction: Sequence[float]) -> Point | None:
    """The surface that a ray meets; None where there is none, or a ray that is none.

    Its error is that of the click across the ray, and along it how thick the Gaussians there are.
    """
    eye, ahead = np.array(origin, np.float64), np.array(direction, np.float64)
    length = float(np.linalg.norm(ahead))
    if not (np.isfinite(eye).all() and 0 < length < math.inf):
        return None
    ahead /= length
    right = np.cross(ahead, np.eye(3)[int(np.argmin(np.abs(ahead)))])
    right /= np.linalg.norm(right)
    K = np.array([[1 / CLICK_ERROR, 0, CLICKED / 2], [0, 1 / CLICK_ERROR, CLICKED / 2], [0, 0, 1]])
    R = np.stack([right, np.cross(ahead, right), ahead]).astype(np.float64)
    depth, alpha = scene.depth(Camera(CLICKED, CLICKED, K, view_matrix(R, eye)))
    middle = CLICKED // 2
    if not alpha[middle, middle] >= 0.5:
        return None
    far = float(depth[middle, middle])
    at = eye + far * ahead
    return Point(at, math.hypot(CLICK_ERROR * far, scene.thickness(at, ahead)))


def told_distance(a: Point, b: Point, world: World) -> str:
    """The distance of two points in words, with half of its 95 % interval."""
    length = world.unit * float(np.linalg.norm(a.at - b.at))
    error = 1.96 * world.unit * math.hypot(a.error, b.error)
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0 else 3
    unit, scale = "units", "; the size of a unit is unknown"
    if world.metres:
        unit, scale = "m", "; without the error of the scale itself"
    return f"{length:.{digits}f} ± {error:.{digits}f} {unit} (95 %{scale})"


class Ruler:
    """The folder "Measure" of the page."""

    def __init__(self, server: Any, scene: Callable[[], Activated | None]) -> None:
        self._server, self._scene = server, scene
        self.world: World = World()
        self._points: list[Point] = []
        self._marks: list[Any] = []
        with server.gui.add_folder("Measure", expand_by_default=False):
            self._on = server.gui.add_checkbox("Click two points", False)
            self.told: Any = server.gui.add_markdown("")
        self._on.on_update(self._switch)

    def clicked(self, event: Any) -> None:
        """A point more; of two the distance is told."""
        scene = self._scene()
        point = None if scene is None else picked(scene, event.ray_origin, event.ray_direction)
        if point is None:
            self.told.content = "No surface there: click on an object."
            return
        if len(self._points) == 2:
            self._clear()
        self._points.append(point)
        radius = 0.004 * float(np.linalg.norm(point.at - np.array(event.ray_origin)))
        ball = self._server.scene.add_icosphere(
            f"/measure/{len(self._points)}", radius=radius, color=(255, 210, 0), position=point.at
        )
        self._marks.append(ball)
        self.told.content = "Click the second point."
        if len(self._points) == 2:
            a, b = self._points
            told, world = told_distance(a, b, self.world), self.world
            # In the frame of the scene's files, whatever a metre is.
            ends = [world.out(point.at) / (world.metres or 1.0) for point in (a, b)]
            given = " ".join(",".join(f"{x:.9g}" for x in end) for end in ends)
            self.told.content = f"{told}\n\nhqgs train: `--distance {given} METRES`"

    def _switch(self, _: object) -> None:
        self._clear()
        if self._on.value:
            self._server.scene.on_pointer_event("click")(self.clicked)
            self.told.content = "Click the first point."
        else:
            self._server.scene.remove_pointer_callback()

    def _clear(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._points, self._marks, self.told.content = [], [], ""
