"""Assembly of the embedded scene: cameras, photos, points, and a cache of what takes time."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path, write_json
from hqgs.scene.builtin.points import SparsePoints, sfm_points
from hqgs.scene.builtin.shading import render_view
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.sfm.run import PROGRAM

FOCAL, WIDTH, HEIGHT = 410.0, 504, 378  # pixels; other sizes scale the intrinsics
FOCUS = (0.05, -0.12, 4.4)  # what the cameras look at
REACH = (0.42, 0.28, 0.08)  # how far the cameras lie from (0, -0.15, 0)


def embedded_scene(
    cache: Path | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
    num_views: int = 24,
    time_limit: float = 60.0,
    threads: int | None = None,
    gloss: float | None = None,
) -> Scene:
    """A room, ray-cast from `num_views` forward-facing cameras; every 8th view is a test view.

    The photos are exact and clean, the cameras known, and no Gaussian is involved. Points come from the
    training photos alone (see `sfm_points`, which takes at most `time_limit` seconds before it falls back);
    `Scene.notes` says how. `gloss` (0 and above) gives every surface that strength of highlight, and a mirror
    that goes with it, in place of its own: 0 is a matte room, where only the lamp shades depend on the view.

    With `cache`, photos and points are kept in that folder and read back next time; a cache that is damaged
    or made by another version is made anew. Raises ValueError if the size is below 1 x 1, `num_views` below 2
    or `gloss` below 0, OSError if `cache` cannot be a folder.
    """
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    if num_views < 2:
        raise ValueError(f"num_views must be at least 2 (one to train, one to test), got {num_views}")
    if gloss is not None and not 0 <= gloss < math.inf:
        raise ValueError(f"gloss must be at least 0 and finite, got {gloss}")
    if cache is not None:
        cache.mkdir(parents=True, exist_ok=True)  # an unusable place shows before the work
    cameras = embedded_cameras(width, height, num_views)
    names = [f"view_{k:02d}.png" for k in range(num_views)]
    made = _read_cache(cache, cameras, names, gloss) if cache is not None else None
    if made is None:
        photos = [render_view(camera, threads=threads, gloss=gloss) for camera in cameras]
        views = [View(*parts) for parts in zip(names, cameras, photos, strict=True)]
        points = sfm_points([v for k, v in enumerate(views) if k % 8], time_limit)
        if cache is not None:
            _write_cache(cache, views, points, gloss)
    else:
        photos, points = made
        views = [View(*parts) for parts in zip(names, cameras, photos, strict=True)]
    train = [v for k, v in enumerate(views) if k % 8]
    return Scene(
        name="embedded",
        train=train,
        test=views[::8],
        points=points.points,
        point_colors=points.colors,
        source="embedded",
        notes=[points.note],
        seen={v.name: np.unique(points.rows[points.photos == k]) for k, v in enumerate(train)},
    )


def embedded_cameras(width: int = WIDTH, height: int = HEIGHT, num_views: int = 24) -> list[Camera]:
    """The cameras of the embedded scene: a jittered sunflower spiral, all but upright, towards one focus."""
    rng = np.random.default_rng(2025)
    fx, fy = FOCAL * width / WIDTH, FOCAL * height / HEIGHT
    K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
    cameras = []
    for k in range(num_views):
        radius, angle = math.sqrt((k + 0.5) / num_views), k * math.pi * (3 - math.sqrt(5))
        jitter = rng.uniform(-1, 1, 5)
        x = math.cos(angle) * radius + 0.08 * jitter[0]
        y = math.sin(angle) * radius + 0.08 * jitter[1]
        center = np.array([0, -0.15, 0]) + np.array([x, y, jitter[2]]) * REACH
        roll = math.radians(1.5 * jitter[3])
        cameras.append(Camera(width, height, K, look_at(center, np.array(FOCUS), roll)))
    return cameras


def look_at(
    center: NDArray[np.float64], target: NDArray[np.float64], roll: float = 0.0
) -> NDArray[np.float64]:
    """World-to-camera matrix [4, 4] of a camera at `center` that looks at `target`; world y points down.

    `roll` (radians) turns the camera about its axis. Raises ValueError if it would look straight up or down.
    """
    z = target - center
    x = np.cross([0.0, 1.0, 0.0], z)
    if np.linalg.norm(x) < 1e-9 * np.linalg.norm(z) or not z.any():
        raise ValueError(f"target must not lie above, below or at the center, got {target} from {center}")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    y = np.cross(z, x)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [math.cos(roll) * x + math.sin(roll) * y, math.cos(roll) * y - math.sin(roll) * x, z]
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return viewmat


def _key(cameras: list[Camera], names: list[str], gloss: float | None) -> dict[str, Any]:
    """What the cached files depend on: the cameras' number and size, the gloss, and the source that makes
    them."""
    source = b"".join(path.read_bytes() for path in [*sorted(Path(__file__).parent.glob("*.py")), PROGRAM])
    return {
        "source": hashlib.sha256(source).hexdigest(),
        "width": cameras[0].width,
        "height": cameras[0].height,
        "num_views": len(names),
        "gloss": gloss,
    }


def _write_cache(cache: Path, views: list[View], points: SparsePoints, gloss: float | None) -> None:
    """Photos and points first, the key with their checksums last, so that a key vouches for whole files."""
    for view in views:
        with atomic_path(cache / view.name) as tmp:
            Image.fromarray(view.image).save(tmp)
    with atomic_path(cache / "points.npz") as tmp:
        np.savez(tmp, points=points.points, colors=points.colors, photos=points.photos, rows=points.rows)
    names = [view.name for view in views]
    files = {name: _checksum(cache / name) for name in [*names, "points.npz"]}
    key = {"made": _key([view.camera for view in views], names, gloss), "files": files, "note": points.note}
    write_json(cache / "key.json", key)


def _read_cache(
    cache: Path, cameras: list[Camera], names: list[str], gloss: float | None
) -> tuple[list[NDArray[np.uint8]], SparsePoints] | None:
    """Photos and points, or None if anything is missing, damaged or made by another version."""
    try:
        key = json.loads((cache / "key.json").read_text(encoding="utf-8"))
        if key["made"] != _key(cameras, names, gloss) or set(key["files"]) != {*names, "points.npz"}:
            return None
        if any(_checksum(cache / name) != digest for name, digest in key["files"].items()):
            return None
        photos = []
        for name in names:
            with Image.open(cache / name) as image:
                photos.append(np.asarray(image))
        with np.load(cache / "points.npz", allow_pickle=False) as data:
            arrays = (data[name] for name in ("points", "colors", "photos", "rows"))
            return photos, SparsePoints(*arrays, note=str(key["note"]))
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
