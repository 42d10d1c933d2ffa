"""Few photos of the room from far apart, and judged between and beyond their cameras."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.room.scene import HEIGHT, WIDTH, assemble, intrinsics, look_at
from hqgs.scene.scene import Camera, Scene

TABLE = (0.0, 0.40, 3.3)  # above the middle of the table top; what the cameras look at
ARC = math.radians(65)  # to either side of the front
RADIUS, LOW, HIGH = 2.8, -0.25, -0.95  # of the arc, and heights of the cameras (y points down)
PHOTOS = 12  # to train on, where no number is given
BETWEEN = 8  # held-out cameras on the same arc, at heights between those of the photos
SIDEWAYS, NEARER, HIGHER = math.radians(8), 0.75, 0.45  # past the arc's ends; of the radius; world units
BEYOND = 6  # held-out cameras, two of each of these


def sparse_cameras(
    width: int = WIDTH, height: int = HEIGHT, num_views: int = 25, seed: int = 2026
) -> list[Camera]:
    """Cameras on an arc of 130 degrees around the room's table, from the left to the right, in turns high and
    low, so that two of one height are 10 degrees apart; each sees the table from about 2.8."""
    rng = np.random.default_rng(seed)
    angles = [ARC * ((2 * k + 1) / num_views - 1) for k in range(num_views)]
    return [
        camera_on_arc(angle, (HIGH, LOW)[k % 2], rng.uniform(-1, 1, 7), width, height)
        for k, angle in enumerate(angles)
    ]


def camera_on_arc(
    angle: float, y: float, jitter: NDArray[np.float64], width: int, height: int, radius: float = RADIUS
) -> Camera:
    """One that looks at the table from `radius` away.

    `angle`: to the right of the front, radians; `y`: its height, downwards; `jitter` [7], -1 to 1: of its
    angle, radius and height, of what it looks at, and of its roll.
    """
    angle, radius = angle + 0.03 * jitter[0], radius + 0.15 * jitter[1]
    x, z = TABLE[0] + radius * math.sin(angle), TABLE[2] - radius * math.cos(angle)
    center = np.array([x, y + 0.15 * jitter[2], z])
    target = np.array(TABLE) + jitter[3:6] * [0.25, 0.12, 0.25]
    viewmat = look_at(center, target, math.radians(2 * jitter[6]))
    return Camera(width, height, intrinsics(width, height), viewmat)


def beyond_room(
    photos: int = PHOTOS, cache: Path | None = None, width: int = WIDTH, height: int = HEIGHT
) -> Scene:
    """The room by `photos` cameras of `sparse_cameras`, all of which are trained on.

    Test views are ray-cast from cameras of their own: 8 called "between", 6 called "beyond" (past the ends
    of the arc, nearer, higher). ValueError for fewer than 2 photos or a size below 1 x 1.
    """
    if photos < 2:
        raise ValueError(f"photos is {photos}, wanted at least 2")
    cameras = sparse_cameras(width, height, photos, seed=7) + between_and_beyond(width, height)
    called = ["between"] * BETWEEN + ["beyond"] * BEYOND
    held_out = {photos + k: name for k, name in enumerate(called)}
    made = {"cameras": "beyond", "photos": photos}
    return assemble("beyond", cameras, cache, made, held_out=held_out)


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
