"""Assembly of the embedded scene: cameras, photos, points, and a cache of what takes time."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.scenes.room.shading import render_depth, render_view
from hqgs.base.files import atomic_path
from hqgs.photos.formation import GOLDEN
from hqgs.scene import paths
from hqgs.scene.constants import PATH_SIZE, TEST_EVERY
from hqgs.scene.geometry import unproject
from hqgs.scene.room import FOLDER
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.sfm.triangulated import TRIANGULATION, SparsePoints, in_order, triangulated

FORMAT = 2  # raised by hand where other photos or points are made, or kept otherwise
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
) -> Scene:
    """A scene of clean photos of the room by these cameras; points from those that are trained on.

    `made` says what cameras depend on beside the photos' size and number, in JSON values, for the key of the
    cache. `held_out`: numbers of the test views, and what they are called; None: every 8th. ValueError for
    cameras below 1 x 1.
    """
    width, height = cameras[0].width, cameras[0].height
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    if held_out is None:
        held_out = dict.fromkeys(range(0, len(cameras), TEST_EVERY), "view")
    if cache is not None:
        cache.mkdir(parents=True, exist_ok=True)  # an unusable place shows before the work
    names = [f"{held_out.get(k, 'view')}_{k:02d}.png" for k in range(len(cameras))]
    made = {"width": width, "height": height, "num_views": len(cameras), **made}
    file = None if cache is None else cache / "room.npz"
    found = None if file is None else kept(file, made)
    if found is None:
        views = [View(name, camera, render_view(camera)) for name, camera in zip(names, cameras, strict=True)]
        points = sfm_points([v for k, v in enumerate(views) if k not in held_out])
        if file is not None:
            photos = {f"photo {view.name}": view.image for view in views}
            keep(file, made, points._asdict() | photos)
    else:
        views = [
            View(name, camera, found[f"photo {name}"]) for name, camera in zip(names, cameras, strict=True)
        ]
        arrays = (found[name] for name in ("points", "colors", "photos", "rows"))
        points = SparsePoints(*arrays, note=str(found["note"]))
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


def keep(file: Path, made: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Write arrays to a file that `kept` reads.

    `made` says, in JSON values, what they depend on beside FORMAT.
    """
    with atomic_path(file) as tmp, tmp.open("wb") as out:
        np.savez_compressed(out, **arrays, made=json.dumps({"format": FORMAT, **made}))


def kept(file: Path, made: Mapping[str, Any]) -> dict[str, Any] | None:
    """The arrays of a file, or None where it is missing, damaged or made in another way."""
    try:
        with np.load(file, allow_pickle=False) as data:
            if str(data["made"]) != json.dumps({"format": FORMAT, **made}):
                return None
            return {name: data[name] for name in data.files if name != "made"}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


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


def sfm_points(views: Sequence[View], time_limit: float = TRIANGULATION) -> SparsePoints:
    """Points of the views by COLMAP.

    COLMAP (SIFT, exhaustive matching, triangulation with the known cameras) runs in its own process and is
    killed after `time_limit` seconds. Where it fails, is late or finds fewer than 200 points, they come from
    `surface_points`, and the note says why. Points are sorted by x, y, z. Raises ValueError without views.
    """
    if not views:
        raise ValueError("views must not be empty")
    found = triangulated(views, time_limit)
    if isinstance(found, SparsePoints):
        return found
    cast = surface_points(views)
    return cast._replace(note=f"{cast.note}, as COLMAP gave none: {found}")


def surface_points(
    views: Sequence[View], count: int = 4000, noise: float = 0.005, seed: int = 0
) -> SparsePoints:
    """`count` points under random pixels of photos of the embedded scene, each seen by its own photo.

    The depth is off by a normal error of standard deviation `noise` times the depth.
    """
    rng = np.random.default_rng(seed)
    points, colors, photos = [], [], []
    for number, (view, share) in enumerate(
        zip(views, np.array_split(np.arange(count), len(views)), strict=True)
    ):
        camera = view.camera
        depth = render_depth(camera)
        rows, cols = np.nonzero(np.isfinite(depth))
        pick = rng.integers(0, len(rows), len(share))
        i, j = rows[pick], cols[pick]
        z = depth[i, j] * (1 + noise * rng.standard_normal(len(pick)))
        points.append(unproject(camera, np.stack([j, i], 1).astype(np.float64) + 0.5, z))
        colors.append(view.image[i, j])
        photos.append(np.full(len(pick), number, np.intp))
    xyz = np.concatenate(points).astype(np.float32)
    note = f"{count} points cast onto the surfaces"
    return in_order(xyz, np.concatenate(colors), np.concatenate(photos), np.arange(count), note)


def write_room(folder: Path) -> None:
    """What `hqgs/scene/room` holds: photos without loss, cameras and points."""
    cameras = embedded_cameras()
    views = [View(f"view_{k:02d}.png", camera, render_view(camera)) for k, camera in enumerate(cameras)]
    for k, view in enumerate(views):
        Image.fromarray(view.image).save(folder / f"{k:02d}.webp", lossless=True, quality=100, method=6)
    points = sfm_points([view for k, view in enumerate(views) if k % TEST_EVERY])
    viewmats = np.stack([camera.viewmat for camera in cameras])
    np.savez_compressed(folder / "room.npz", K=cameras[0].K, viewmats=viewmats, **points._asdict())


if __name__ == "__main__":
    write_room(FOLDER)
