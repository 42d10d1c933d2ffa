"""A test kit for viewers: a small scene in which each fault shows, cameras, and right pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import CAMERAS, atomic_path, check_new_folder, write_json
from hqgs.evaluation.viewers.plain import render
from hqgs.model.constants import SH_C0
from hqgs.model.formats.arrays import Arrays
from hqgs.model.formats.files import format_of, read_scene
from hqgs.model.formats.ply import write_ply
from hqgs.model.formats.spz import write_spz
from hqgs.photos.pixels import to_uint8
from hqgs.scene.paths import UP
from hqgs.scene.scene import Camera

WIDTH, HEIGHT, FOCAL, VIEWS = 320, 240, 260.0, 3
MIDDLE = np.array([37.0, -12.0, 20.0])  # off the origin, where positions of 16 bits are coarse
NEAR_RADIUS, FAR_DEPTHS = 2.0, (25.0, 90.0)  # of the heap; of two curtains behind it, each in view at a side
DISTANCE = 6.0  # of the cameras
PLAIN, COMPENSATED = "plain", "antialiased"  # the scene twice: without the flag, and with it
FILES = {PLAIN: "plain.ply", COMPENSATED: "antialiased.spz"}


def kit_scene(seed: int = 0) -> Arrays:
    """Solid and thin, faint and bright, large and smaller than a pixel, near and far: 980 Gaussians."""
    rng = np.random.default_rng(seed)
    parts = [
        _heap(rng, 300, (0.12, 0.3), (0.3, 0.95)),  # that hide one another
        _heap(rng, 250, (0.05, 0.25), (0.02, 0.2)),  # faint layers
        _heap(rng, 250, (0.002, 0.008), (0.8, 0.99)),  # smaller than a pixel
        _heap(rng, 60, (0.003, 0.008), (0.7, 0.95), longest=60.0),  # needles
    ]
    for depth, side in zip(FAR_DEPTHS, (-1, 1), strict=True):
        parts.append(_curtain(rng, 60, depth, side))
    order = rng.permutation(sum(len(part["means"]) for part in parts))  # a file's is not that of the depths

    def joined(name: Literal["means", "scales", "quats", "opacities", "sh0", "shN"]) -> NDArray[np.float32]:
        return np.concatenate([part[name] for part in parts])[order].astype(np.float32)

    return {
        "means": joined("means"),
        "scales": joined("scales"),
        "quats": joined("quats"),
        "opacities": joined("opacities"),
        "sh0": joined("sh0"),
        "shN": joined("shN"),
    }


def kit_cameras() -> list[Camera]:
    """On an arc before the heap, each a little higher and rolled."""
    cameras = []
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    for k in range(VIEWS):
        angle, roll = math.radians(25 * (k - (VIEWS - 1) / 2)), math.radians(6 * k)
        eye = MIDDLE + DISTANCE * np.array([math.sin(angle), -0.1 * k, -math.cos(angle)])
        ahead = (MIDDLE - eye) / np.linalg.norm(MIDDLE - eye)
        right = np.cross([math.sin(roll), math.cos(roll), 0.0], ahead)
        right /= np.linalg.norm(right)
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        cameras.append(Camera(WIDTH, HEIGHT, K, viewmat))
    return cameras


def picture_name(which: str, number: int) -> str:
    """Of a reference picture, and of the screenshot that is compared with it."""
    return f"{which}_{number}.png"


def write_kit(folder: Path) -> list[str]:
    """Write the kit into a new folder; return the names of its files. FileExistsError where it is not new."""
    check_new_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scene, cameras = kit_scene(), kit_cameras()
    flagged: Arrays = {**scene, "antialiased": True}
    write_ply(folder / FILES[PLAIN], scene)
    write_spz(folder / FILES[COMPENSATED], flagged)
    views = [
        {
            "name": str(number),
            "held_out": True,
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "world_to_camera": camera.viewmat.tolist(),
            "photo": picture_name(PLAIN, number),
        }
        for number, camera in enumerate(cameras)
    ]
    frame = "OpenCV: x right, y down, z forward; pixels; background black"
    write_json(folder / CAMERAS, {"frame": frame, "up": [*UP], "views": views})
    for which in FILES:
        arrays = kit_file(folder, which)  # as it is in the file, which rounds
        for number, camera in enumerate(cameras):
            with atomic_path(folder / picture_name(which, number)) as tmp:
                Image.fromarray(to_uint8(render(arrays, camera).astype(np.float32))).save(tmp)
    return sorted(path.name for path in folder.iterdir())


def kit_file(folder: Path, which: str) -> Arrays:
    """The scene of a kit in a folder: PLAIN or COMPENSATED."""
    path = folder / FILES[which]
    return read_scene(path, format_of(path))


def screenshots(path: Path, cameras: int) -> dict[str, dict[int, Path]]:
    """Pictures of a viewer by scene and camera: a file, or those in a folder, named as the kit's are.

    FileNotFoundError or ValueError where there is none.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}")
    files = {file.stem.lower(): file for file in (sorted(path.iterdir()) if path.is_dir() else [path])}
    found: dict[str, dict[int, Path]] = {}
    for which in FILES:
        for number in range(cameras):
            if (file := files.get(Path(picture_name(which, number)).stem)) is not None:
                found.setdefault(which, {})[number] = file
    if not found:
        raise ValueError(
            f"{path} holds no screenshot under the name of one of the kit's pictures, such as "
            f"{picture_name(PLAIN, 0)}"
        )
    return found


def read_screenshot(path: Path) -> NDArray[np.uint8]:
    """[H, W, 3]; what is transparent is black. ValueError where it is no picture."""
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGBA"))
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{path} is no picture: {error}") from error
    return np.rint(pixels[..., :3] * (pixels[..., 3:] / 255.0)).astype(np.uint8)


def _heap(
    rng: np.random.Generator,
    count: int,
    sizes: tuple[float, float],
    opacities: tuple[float, float],
    longest: float = 3.0,
) -> Arrays:
    """In a ball around the middle; each up to `longest` times as long as it is thick."""
    away = rng.normal(size=(count, 3))
    away *= (
        NEAR_RADIUS * rng.uniform(0, 1, (count, 1)) ** (1 / 3) / np.linalg.norm(away, axis=1, keepdims=True)
    )
    scales = np.exp(rng.uniform(math.log(sizes[0]), math.log(sizes[1]), (count, 1))) * np.ones(3)
    scales[:, 0] *= rng.uniform(longest / 2, longest, count)
    return _gaussians(rng, MIDDLE + away, scales, rng.uniform(*opacities, count))


def _curtain(rng: np.random.Generator, count: int, depth: float, side: int) -> Arrays:
    """So far behind the middle, on one side of the pictures."""
    across = (DISTANCE + depth) * WIDTH / (2 * FOCAL)
    places = np.stack([rng.uniform(0.2, 1.2, count) * side * across, rng.uniform(-1, 1, count) * across], -1)
    means = MIDDLE + np.concatenate([places, np.full((count, 1), depth)], 1)
    scales = np.full((count, 3), 0.1 * across) * rng.uniform(0.5, 1.2, (count, 3))
    return _gaussians(rng, means, scales, rng.uniform(0.4, 0.95, count))


def _gaussians(
    rng: np.random.Generator, means: np.ndarray, scales: np.ndarray, opacities: np.ndarray
) -> Arrays:
    """Colours from dark to beyond white, and different from each side."""
    count = len(means)
    colors = rng.uniform(0, 1, (count, 3)) * rng.choice([0.5, 1.0, 1.5], (count, 1))
    quats = rng.normal(size=(count, 4))
    made: Arrays = {
        "means": means.astype(np.float32),
        "scales": np.log(scales).astype(np.float32),
        "quats": (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        "opacities": np.log(opacities / (1 - opacities)).astype(np.float32),
        "sh0": ((colors - 0.5) / SH_C0).astype(np.float32)[:, None],
        "shN": rng.normal(0, 0.15, (count, 15, 3)).astype(np.float32),
    }
    return made
