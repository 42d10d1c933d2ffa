"""The built-in scene, as data: 24 photos of a ray-cast room, exact and clean, and points that COLMAP found.

No Gaussian is involved; the room itself, and what made these files, are in `benchmarks/scenes/room/`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hqgs.photos.files import decode
from hqgs.scene.constants import PATH_SIZE, SMALLEST_SIDE, TEST_EVERY
from hqgs.scene.geometry import resized
from hqgs.scene.scene import Camera, Scene, View

FOLDER = Path(__file__).parent  # of the photos, NN.webp, and of room.npz


def embedded_scene(width: int, height: int) -> Scene:
    """The room with photos of this size, at most 504 x 378 px; every 8th view is a test view.

    ValueError for a side below 8 px.
    """
    if min(width, height) < SMALLEST_SIDE:
        raise ValueError(f"photos of {width} x {height} px: each side needs {SMALLEST_SIDE}")
    with np.load(FOLDER / "room.npz", allow_pickle=False) as data:
        K, viewmats = data["K"], data["viewmats"]
        points, colors, photos, rows, note = (data[k] for k in ("points", "colors", "photos", "rows", "note"))
    views = []
    for k, viewmat in enumerate(viewmats):
        image, _ = decode(FOLDER / f"{k:02d}.webp")
        view = View(f"view_{k:02d}.png", Camera(*PATH_SIZE, K, viewmat), image)
        views.append(view if (width, height) == PATH_SIZE else resized(view, width, height))
    train = [view for k, view in enumerate(views) if k % TEST_EVERY]
    return Scene(
        name="embedded",
        train=train,
        test=views[::TEST_EVERY],
        points=points,
        point_colors=colors,
        source="embedded",
        notes=[str(note)],
        seen={view.name: np.unique(rows[photos == k]) for k, view in enumerate(train)},
    )
