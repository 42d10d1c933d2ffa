"""Points to start from for cameras that came without any: by COLMAP, where photos tell them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hqgs.base.files import atomic_path
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.scene.random_points import FEWEST, NO_POINTS, too_few
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.run import key_of
from hqgs.scene.sfm.triangulated import SparsePoints, triangulated


def with_points(scene: Scene, keep: Path | None = None, on_stage: OnStage = silent) -> Scene:
    """The scene with points of its training photos, and which photo sees which, in place of random ones.

    As it is where it has points enough of its own, photos are tiny, or COLMAP finds too few; a note says why.
    `keep`: a folder for what is found.
    """
    views = scene.train
    sides = [min(view.camera.width, view.camera.height) for view in views]
    own = not scene.guessed and len(scene.points) >= FEWEST
    if own or len(views) < 2 or min(sides) < 100:  # COLMAP finds none in smaller ones
        return scene
    on_stage(Stage("COLMAP: points for the given cameras", 0, 0))
    file = None if keep is None else keep / f"points-{key_of('points', _pieces(scene))}.npz"
    if file is not None and file.is_file():
        with np.load(file, allow_pickle=False) as data:
            found = SparsePoints(
                **{name: data[name] for name in ("points", "colors", "photos", "rows")},
                note=str(data["note"]),
            )
    else:
        found = triangulated(views)
        if isinstance(found, SparsePoints) and file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(file) as tmp, tmp.open("wb") as out:
                np.savez(out, **found._asdict())
    if isinstance(found, str):
        return replace(scene, notes=[*scene.notes, f"COLMAP found no points for these cameras: {found}"])
    notes = [note for note in scene.notes if not note.startswith(NO_POINTS)]
    seen = {view.name: np.unique(found.rows[found.photos == k]) for k, view in enumerate(views)}
    return replace(
        scene,
        points=found.points,
        point_colors=found.colors,
        seen=seen,
        guessed=False,
        notes=[*notes, f"{too_few(scene)}: {found.note}"],
    )


def _pieces(scene: Scene) -> Iterator[bytes]:
    """The photos and cameras."""
    for view in scene.train:
        for array in (view.image, view.mask, view.camera.K, view.camera.viewmat):
            yield b"-" if array is None else np.ascontiguousarray(array).tobytes()
