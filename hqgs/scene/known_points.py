"""Points to start from for cameras that came without any: by COLMAP, where photos tell them, else random."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hqgs.base.files import atomic_path
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.scene.geometry import unproject
from hqgs.scene.paths import sight_lines
from hqgs.scene.scene import Scene, View
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


RANDOM_POINTS = 20_000  # to start from where a scene has none

NO_POINTS = "no points in the scene"
FEWEST = 4  # to start from: each takes its size from three neighbours


def with_first_points(scene: Scene, near_far: Mapping[str, tuple[float, float]] | None = None) -> Scene:
    """The scene with `random_points` in place of its own, where those are fewer than FEWEST."""
    if len(scene.points) >= FEWEST:
        return scene
    points, colors, note = random_points(scene.train, near_far or {})
    notes = [*scene.notes, f"{too_few(scene)}: {note}"]
    return replace(scene, points=points, point_colors=colors, notes=notes, seen=None, guessed=True)


def too_few(scene: Scene) -> str:
    """What to say of a scene with fewer points than FEWEST."""
    few = "" if scene.guessed or not len(scene.points) else f" but {len(scene.points)}, too few to start from"
    return NO_POINTS + few


def random_points(
    views: list[View], near_far: Mapping[str, tuple[float, float]]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], str]:
    """Seeded random points in the frusta of the training `views`, coloured by the pixel they were drawn at.

    Depths are uniform in the logarithm between the view's near and far bound. Where a view has none in
    `near_far`, it is guessed: 0.3 to 3 times the distance to the point the cameras look at, or, for cameras
    that look in nearly one direction, 0.5 to 50 times the radius of their positions. Returns points [P, 3]
    in world units, colours [P, 3], and a note that says what was done.
    """
    rng = np.random.default_rng(0)
    guessed = {} if all(v.name in near_far for v in views) else _guess_near_far(views)
    points, colors = [], []
    for i, view in enumerate(views):
        count = RANDOM_POINTS * (i + 1) // len(views) - RANDOM_POINTS * i // len(views)
        cells = np.arange(view.image.shape[0] * view.image.shape[1])
        shown = view.mask if view.empty is None else view.empty < 255
        if shown is not None:
            cells = cells[shown.ravel()]
        if len(cells) == 0:
            continue
        rows, columns = np.divmod(rng.choice(cells, count), view.camera.width)
        near, far = near_far.get(view.name) or guessed[view.name]
        depth = np.exp(rng.uniform(np.log(near), np.log(far), count))
        points.append(unproject(view.camera, np.stack([columns + 0.5, rows + 0.5], 1), depth))
        colors.append(view.image[rows, columns])
    if not points:
        raise ValueError("the masks hide every pixel of every training view")
    depths = "a guessed depth range" if guessed else "the given depth bounds"
    note = (
        f"{RANDOM_POINTS} random points within {depths} of the training views; "
        "`--sfm` finds cameras and points from the photos"
    )
    return np.concatenate(points), np.concatenate(colors), note


def _guess_near_far(views: list[View]) -> dict[str, tuple[float, float]]:
    centers, axes, normal, moment = sight_lines([view.camera for view in views])
    if np.linalg.eigvalsh(normal)[0] > 0.05:  # the axes spread by about 13 degrees or more
        focus = np.linalg.solve(normal, moment)
        depths = ((focus - centers) * axes).sum(1)
        if (depths > 0).all():
            return {v.name: (0.3 * d, 3 * d) for v, d in zip(views, depths.tolist(), strict=True)}
    radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) or 1.0
    return {v.name: (0.5 * radius, 50 * radius) for v in views}
