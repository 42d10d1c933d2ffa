"""How long things are: a bar in the picture, and the distance of two clicked points, with its error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from hqgs.scene.paths import view_matrix
from hqgs.scene.scene import Camera
from hqgs.scene.world import World
from hqgs.show.frames import Activated
from hqgs.show.viewer.pictures import Picture

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


def told_points(a: Point, b: Point, world: World) -> str:
    """How the two points are given to --distance: in the frame of the scene's files, whatever a metre is."""
    ends = (world.out(point.at) / (world.metres or 1.0) for point in (a, b))
    return "--distance " + " ".join(",".join(f"{x:.9g}" for x in end) for end in ends) + " METRES"


def with_bar(picture: Picture, camera: Camera, depth: float, world: World) -> Picture:
    """The picture with a bar that is as long as it says at that depth (world units)."""
    margin, thick, high = 16, 4, 16  # px
    longest = 0.25 * picture.shape[1] * depth / camera.K[0, 0] * world.unit
    if not 0 < longest < math.inf:
        return picture
    power = 10.0 ** math.floor(math.log10(longest))
    length = next(step * power for step in (5, 2, 1) if step * power <= longest)
    pixels = length / world.unit / depth * camera.K[0, 0]
    shown = Image.fromarray(picture)
    draw = ImageDraw.Draw(shown)
    x, y = margin, picture.shape[0] - margin
    draw.rectangle((x - 1, y - thick - 1, x + pixels + 1, y + 1), fill=(0, 0, 0))
    draw.rectangle((x, y - thick, x + pixels, y), fill=(255, 255, 255))
    text = f"{length:g} {'m' if world.metres else 'units'}"
    place, font = (x, y - thick - high - 6), ImageFont.load_default(high)
    draw.text(place, text, fill=(255, 255, 255), font=font, stroke_width=2, stroke_fill=(0, 0, 0))
    return np.array(shown)


class Ruler:
    """The folder "Measure" of the page."""

    def __init__(
        self, server: Any, scene: Callable[[], Activated | None], refresh: Callable[[], None]
    ) -> None:
        self._server, self._scene, self._refresh = server, scene, refresh
        self.world: World = World()
        self._points: list[Point] = []
        self._marks: list[Any] = []
        with server.gui.add_folder("Measure", expand_by_default=False):
            self._on = server.gui.add_checkbox("Click two points", False)
            self._bar = server.gui.add_checkbox("Scale bar", False, hint="as long as it says in the middle")
            self.told: Any = server.gui.add_markdown("")
        self._on.on_update(self._switch)
        self._bar.on_update(lambda _: refresh())

    def over(self, picture: Picture, camera: Camera) -> Picture:
        """The picture with the bar, where that is asked for."""
        scene = self._scene()
        if not self._bar.value or scene is None:
            return picture
        point = picked(scene, camera.center.tolist(), camera.viewmat[2, :3].tolist())
        if point is None:
            return picture
        return with_bar(picture, camera, float(np.linalg.norm(point.at - camera.center)), self.world)

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
            told, given = told_distance(a, b, self.world), told_points(a, b, self.world)
            self.told.content = f"{told}\n\nhqgs train: `{given}`"

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
