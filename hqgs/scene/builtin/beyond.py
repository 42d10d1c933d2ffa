"""Few photos of the room, judged where nobody stood: between the cameras, and beyond them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from hqgs.scene.builtin.points import TIME_LIMIT
from hqgs.scene.builtin.scene import HEIGHT, WIDTH, assemble
from hqgs.scene.builtin.sparse import ARC, HIGH, LOW, RADIUS, camera_on_arc
from hqgs.scene.scene import Camera, Scene

PHOTOS = 12  # to train on, where no number is given
BETWEEN = 8  # held-out cameras on the same arc, at heights between those of the photos
SIDEWAYS, NEARER, HIGHER = math.radians(8), 0.75, 0.45  # past the arc's ends; of the radius; world units
BEYOND = 6  # held-out cameras, two of each of these


def beyond_room(
    photos: int = PHOTOS,
    cache: Path | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
    time_limit: float = TIME_LIMIT,
    threads: int | None = None,
) -> Scene:
    """The room by `photos` cameras on the arc of `sparse_room`, all of which are trained on.

    Test views are ray-cast from cameras of their own: 8 called "between", 6 called "beyond" (past the ends
    of the arc, nearer, higher). ValueError for fewer than 2 photos or a size below 1 x 1.
    """
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    if photos < 2:
        raise ValueError(f"photos is {photos}, wanted at least 2")
    cameras = arc_cameras(photos, width, height) + between_and_beyond(width, height)
    called = ["between"] * BETWEEN + ["beyond"] * BEYOND
    held_out = {photos + k: name for k, name in enumerate(called)}
    made = {"cameras": "beyond", "photos": photos}
    return assemble("beyond", cameras, cache, time_limit, threads, None, made, held_out=held_out)


def arc_cameras(photos: int, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Those to train on, from the left to the right, in turns low and high."""
    rng = np.random.default_rng(7)
    angles = [ARC * ((2 * k + 1) / photos - 1) for k in range(photos)]
    return [
        camera_on_arc(angle, (HIGH, LOW)[k % 2], rng.uniform(-1, 1, 7), width, height)
        for k, angle in enumerate(angles)
    ]


def between_and_beyond(width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """The held-out ones: the same, however many photos there are."""
    rng, middle = np.random.default_rng(8), (LOW + HIGH) / 2
    cameras = []
    for k in range(BETWEEN):
        angle = ARC * (2 * (k + 1) / (BETWEEN + 1) - 1)
        cameras.append(camera_on_arc(angle, middle, rng.uniform(-1, 1, 7), width, height))
    for k in range(BEYOND):
        angle, radius, y = ARC * (2 * (k + 1) / (BEYOND + 1) - 1), RADIUS, middle
        kind = k % 3
        if kind == 0:
            angle = math.copysign(ARC + SIDEWAYS, angle)
        elif kind == 1:
            radius *= NEARER
        else:
            y = HIGH - HIGHER
        cameras.append(camera_on_arc(angle, y, rng.uniform(-1, 1, 7), width, height, radius))
    return cameras
