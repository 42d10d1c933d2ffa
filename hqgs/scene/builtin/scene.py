"""Assembly of the embedded scene: cameras, photos, points, and a cache of what takes time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.photos.constants import GOLDEN
from hqgs.scene import paths
from hqgs.scene.builtin.cache import Kept, read_kept, write_kept
from hqgs.scene.builtin.points import SparsePoints, sfm_points
from hqgs.scene.builtin.shading import render_view
from hqgs.scene.constants import PATH_SIZE, TEST_EVERY
from hqgs.scene.scene import Camera, Scene, View

WIDTH, HEIGHT = PATH_SIZE
FOCAL = 410.0  # px; other sizes scale the intrinsics
FOCUS = (0.05, -0.12, 4.4)  # what the cameras look at
REACH = (0.42, 0.28, 0.08)  # how far the cameras lie from (0, -0.15, 0)


def embedded_scene(
    cache: Path | None = None, width: int = WIDTH, height: int = HEIGHT, num_views: int = 24
) -> Scene:
    """A room, ray-cast from `num_views` forward-facing cameras; every 8th view is a test view.

    The photos are exact and clean, the cameras known, and no Gaussian is involved. Points come from the
    training photos alone (`sfm_points`); `Scene.notes` says how.

    With `cache`, photos and points are kept in that folder and read back next time; a cache that is damaged
    or made by another version is made anew. Raises ValueError if the size is below 1 x 1 or `num_views` below
    2, OSError if `cache` cannot be a folder.
    """
    if num_views < 2:
        raise ValueError(f"num_views must be at least 2 (one to train, one to test), got {num_views}")
    return assemble("embedded", embedded_cameras(width, height, num_views), cache, {})


def assemble(
    name: str,
    cameras: list[Camera],
    cache: Path | None,
    made: dict[str, Any],
    held_out: Mapping[int, str] | None = None,
    names: Sequence[str] | None = None,
) -> Scene:
    """A scene of clean photos of the room by these cameras; points from those that are trained on.

    `made` says what cameras depend on beside the photos' size and number, in JSON values, for the key of the
    cache. `held_out`: numbers of the test views, and what they are
    called; None: every 8th. `names`: of all views, in place of `view_NN.png` and such. ValueError for
    cameras below 1 x 1.
    """
    width, height = cameras[0].width, cameras[0].height
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    if held_out is None:
        held_out = dict.fromkeys(range(0, len(cameras), TEST_EVERY), "view")
    if cache is not None:
        cache.mkdir(parents=True, exist_ok=True)  # an unusable place shows before the work
    if names is None:
        names = [f"{held_out.get(k, 'view')}_{k:02d}.png" for k in range(len(cameras))]
    made = {"width": width, "height": height, "num_views": len(cameras), **made}
    kept = None if cache is None else read_kept(cache, made, names)
    if kept is None:
        photos = {name: render_view(camera) for name, camera in zip(names, cameras, strict=True)}
        views = [View(name, camera, photos[name]) for name, camera in zip(names, cameras, strict=True)]
        points = sfm_points([v for k, v in enumerate(views) if k not in held_out])
        if cache is not None:
            arrays = {key: value for key, value in points._asdict().items() if key != "note"}
            write_kept(cache, made, Kept(photos, arrays, points.note))
    else:
        views = [View(name, camera, kept.photos[name]) for name, camera in zip(names, cameras, strict=True)]
        points = SparsePoints(**kept.arrays, note=kept.note)
    train = [v for k, v in enumerate(views) if k not in held_out]
    return Scene(
        name=name,
        train=train,
        test=[views[k] for k in sorted(held_out)],
        points=points.points,
        point_colors=points.colors,
        source="embedded",
        notes=[points.note],
        seen={v.name: np.unique(points.rows[points.photos == k]) for k, v in enumerate(train)},
    )


def embedded_cameras(width: int = WIDTH, height: int = HEIGHT, num_views: int = 24) -> list[Camera]:
    """The cameras of the embedded scene: a jittered sunflower spiral, all but upright, towards one focus."""
    rng = np.random.default_rng(2025)
    cameras = []
    for k in range(num_views):
        radius, angle = math.sqrt((k + 0.5) / num_views), GOLDEN * k
        jitter = rng.uniform(-1, 1, 5)
        x = math.cos(angle) * radius + 0.08 * jitter[0]
        y = math.sin(angle) * radius + 0.08 * jitter[1]
        center = np.array([0, -0.15, 0]) + np.array([x, y, jitter[2]]) * REACH
        roll = math.radians(1.5 * jitter[3])
        viewmat = look_at(center, np.array(FOCUS), roll)
        cameras.append(Camera(width, height, intrinsics(width, height), viewmat))
    return cameras


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """K [3, 3] of the room's cameras at another size than 504 x 378 px."""
    fx, fy = FOCAL * width / WIDTH, FOCAL * height / HEIGHT
    return np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])


def look_at(
    center: NDArray[np.float64], target: NDArray[np.float64], roll: float = 0.0
) -> NDArray[np.float64]:
    """World-to-camera matrix [4, 4] of a camera at `center` that looks at `target`; world y points down.

    `roll` (radians) turns the camera about its axis. Raises ValueError if it would look straight up or down.
    """
    x, y, z = paths.look_at(center, target).viewmat[:3, :3]
    axes = [math.cos(roll) * x + math.sin(roll) * y, math.cos(roll) * y - math.sin(roll) * x, z]
    return paths.view_matrix(np.array(axes), center)
