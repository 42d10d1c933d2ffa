"""`parts`: a made-up city, listed and split; how long that takes and how much memory it needs."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from benchmarks.output import Benchmark, Report, table
from hqgs.base.machine import peak_rss_mb
from hqgs.scene.formats.colmap_stream import (
    PIXEL,
    POINT,
    Points,
    StoredImage,
    put_count,
    write_cameras,
    write_image,
    write_points,
)
from hqgs.scene.split import split

FULL = {"photos": 10_000, "points": 50_000_000, "parts": 32}
QUICK = {"photos": 64, "points": 6_400, "parts": 4}
WIDTH, HEIGHT, FOCAL = 64, 48, 24.0
SPACING, ALTITUDE, ROOFS = 10.0, 20.0, 3.0  # world units: between photos, above the ground, highest roof
LOOKS = ((0, 0), (1, 0), (0, 1))  # photos that show a point: that of its block, and of two beside it


def write_city(root: Path, photos: int, points: int) -> None:
    """A COLMAP folder: photos on a square grid that look straight down, as many points in each one's block.

    A point is shown by three photos, but at the border. Ids are shuffled, as COLMAP's are. One block is in
    memory at a time. ValueError unless the numbers make whole blocks.
    """
    side, each = math.isqrt(photos), points // photos
    if side * side != photos or side < 2 or each * photos != points or not each:
        raise ValueError(f"photos is {photos} and points {points}: wanted a square, and a multiple of it")
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    Image.new("RGB", (WIDTH, HEIGHT), (120, 120, 120)).save(root / "images" / "0.jpg")
    params = [FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=params)
    write_cameras(model / "cameras.bin", {1: camera})
    with (model / "points3D.bin").open("wb") as file:
        put_count(file, points)
        for block in range(photos):
            write_points(file, block_points(block, side, each, points))
    with (model / "images.bin").open("wb") as file:
        put_count(file, photos)
        for number in range(photos):
            write_image(file, *photo(number, side, each, points))
            name = photo_name(number)
            if name != "0.jpg":
                (root / "images" / name).hardlink_to(root / "images" / "0.jpg")


def photo_name(number: int) -> str:
    return f"{number}.jpg"


def block_points(block: int, side: int, each: int, points: int) -> Points:
    """The points below a photo, with their tracks."""
    heads = np.zeros(each, POINT)
    heads["id"], heads["xyz"] = ids(block, each, points), places(block, side, each)
    heads["rgb"], heads["error"] = 128, 0.5
    looks = [look for look in LOOKS if _beside(block, look, side) is not None]
    heads["length"] = len(looks)
    track = np.empty((each, len(looks), 2), np.uint32)
    for k, look in enumerate(looks):
        other = _beside(block, look, side)
        assert other is not None
        track[:, k, 0] = other + 1
        track[:, k, 1] = _blocks(other, side).index(block) * each + np.arange(each)
    return Points(heads, track.reshape(-1, 2))


def photo(number: int, side: int, each: int, points: int) -> tuple[StoredImage, NDArray[np.int64]]:
    """A photo, and the ids of the points that its pixels show."""
    center = np.array([*_middle(number, side), -ALTITUDE])
    blocks = _blocks(number, side)
    seen = np.concatenate([places(block, side, each) for block in blocks]) - center
    pixels = np.zeros(len(seen), PIXEL)
    pixels["xy"] = FOCAL * seen[:, :2] / seen[:, 2:] + (WIDTH / 2, HEIGHT / 2)
    image = StoredImage(number + 1, photo_name(number), 1, np.array([1.0, 0, 0, 0]), -center, pixels)
    return image, np.concatenate([ids(block, each, points) for block in blocks])


def places(block: int, side: int, each: int) -> NDArray[np.float64]:
    """Where a block's points lie, [each, 3]; z points down."""
    rng = np.random.default_rng(block)
    at = rng.uniform([-SPACING / 2, -SPACING / 2, -ROOFS], [SPACING / 2, SPACING / 2, 0.0], (each, 3))
    return at + np.array([*_middle(block, side), 0.0])


def ids(block: int, each: int, points: int) -> NDArray[np.int64]:
    """Ids of a block's points, [each]: 1 to `points`, without an order."""
    step = next(s for s in range(int(points * 0.618) | 1, 2 * points + 3) if math.gcd(s, points) == 1)
    return (np.arange(block * each, (block + 1) * each) * step) % points + 1


def _middle(block: int, side: int) -> tuple[float, float]:
    return SPACING * (block % side), SPACING * (block // side)


def _beside(block: int, look: tuple[int, int], side: int) -> int | None:
    x, y = block % side + look[0], block // side + look[1]
    return y * side + x if x < side and y < side else None


def _blocks(number: int, side: int) -> list[int]:
    """The blocks that a photo shows."""
    x, y = number % side, number // side
    return [(y - dy) * side + x - dx for dx, dy in LOOKS if x >= dx and y >= dy]


def measured(scene: str, out: str, parts: int) -> dict[str, Any]:
    """Split in a process of its own: seconds and the largest memory, MB, of all of it."""
    start = time.perf_counter()
    made = split(scene, out, parts)
    seconds = time.perf_counter() - start
    facts = {"seconds": seconds, "peak_rss_mb": peak_rss_mb(), "train": made.train, "points": made.points}
    return facts | {"parts": [asdict(part) for part in made.parts]}


def run(args: argparse.Namespace) -> Report:
    """Write the city, split it, say what that took."""
    sizes = QUICK if args.quick else FULL
    photos, points, parts = (
        sizes[name] if getattr(args, name) is None else getattr(args, name) for name in sizes
    )
    work = Path(tempfile.mkdtemp(prefix="parts-", dir=args.out))
    try:
        print(f"parts: writing {photos:,} photos and {points:,} points", file=sys.stderr, flush=True)
        write_city(work / "city", photos, points)
        model = sum(file.stat().st_size for file in (work / "city" / "sparse" / "0").iterdir())
        print(f"parts: splitting {model / 1e9:.2f} GB of model", file=sys.stderr, flush=True)
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            found = pool.submit(measured, str(work / "city"), str(work / "split"), parts).result()
    finally:
        shutil.rmtree(work)
    each, columns = (
        found["parts"],
        {
            "photos": ("photos", ",d"),
            "points": ("points", ",d"),
            "model_gb": ("model (GB)", ".2f"),
            "parts": ("parts", "d"),
            "seconds": ("seconds", ".0f"),
            "peak_gb": ("peak memory (GB)", ".2f"),
            "most_photos": ("photos of a part", ",d"),
            "most_points": ("points of a part", ",d"),
        },
    )
    row = {
        "photos": photos,
        "points": points,
        "model_gb": model / 1e9,
        "parts": parts,
        "seconds": found["seconds"],
        "peak_gb": None if found["peak_rss_mb"] is None else found["peak_rss_mb"] / 1e3,
        "most_photos": max(part["train"] + part["held_out"] for part in each),
        "most_points": max(part["points"] for part in each),
    }
    report = Report({"photos": photos, "points": points, "parts": parts}, results={**found, **row})
    report.tables.append(table("A made-up city, listed and split", [row], columns))
    return report


def _option(name: str) -> dict[str, Any]:
    return {"type": int, "metavar": "N", "help": f"({FULL[name]:,}, with --quick {QUICK[name]:,})"}


OPTIONS = {f"--{name}": _option(name) for name in FULL}
BENCHMARK = Benchmark("time and memory of splitting a city that was made up", run, options=OPTIONS)
