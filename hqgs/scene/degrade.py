"""Scenes with degraded training photos: in memory, or written as a folder that `load_scene` reads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path, new_folder
from hqgs.base.text import some
from hqgs.photos.degrade import FILES, FILMS, Degraded, Record, degrade_sequence
from hqgs.photos.formula import Degradation
from hqgs.photos.pixels import to_uint8
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.scene.capture import inside
from hqgs.scene.formats.colmap import write_colmap
from hqgs.scene.formats.degradation_json import DegradedFolder, write_degraded_folder
from hqgs.scene.scene import Scene, View


def degrade_scene(scene: Scene, degradation: Degradation, seed: int) -> Scene:
    """The scene with degraded training photos (float32, `View.low` with low-res); held-out ones as they are.

    Each photo has a generator of its own, from the seed and the photo's place among all names, so that no
    photo depends on another, unless there is a video: all photos, sorted by name and held-out ones included,
    are its frames, and the held-out ones in it are degraded like the others, but not kept.

    A `some` step happens to half of the training photos, rounded up. Each photo draws a number and a factor
    uniform in [0.5, 1.5]; the half with the smallest numbers get the step with the factor times its value,
    within the kind's range. All `some` steps of a degradation share both.

    `Scene.notes` gets a line with the kind, the seed and the photos. ValueError for a negative seed, a photo
    that is too small for a blur, or photos of several sizes before a video; the last two name the photo.
    """
    train = [
        replace(view, image=result.image, low=result.low, film=None, empty=None)
        for view, result in degraded_views(scene, degradation, seed)
    ]
    note = _note(scene, degradation, seed, "kept as 32-bit floats")
    return replace(scene, train=train, notes=[*scene.notes, note])


def write_degraded_scene(scene: Scene, out: str | Path, degradation: Degradation, seed: int) -> None:
    """Degrade as `degrade_scene` does and write a scene folder with the same cameras, points and split.

    It holds a COLMAP model (pinhole cameras), `images` and, where the scene has masks, `masks`. Held-out
    photos are PNGs of the clean pixels. Where JPEG is the last step of all photos, or a phone, the training
    photos are the JPEG files themselves, otherwise PNGs, clipped and rounded to 8 bits. With low-res, the
    small photos are stored in this way in `low`, and `images` holds PNGs of the enlarged ones. The suffixes
    of names follow the files. `degradation.json` tells kind, seed, photos and what happened to each of them.

    All is written beside `out` and then moved there: after an error or Ctrl-C `out` is as it was. Raises
    FileExistsError unless `out` is missing or an empty folder; ValueError as `degrade_scene` does, or where
    the new suffixes would mix up the photos' names.
    """
    last_step = degradation.steps[-1] if degradation.steps else None
    jpeg_last = last_step is not None and last_step.kind in FILES and not last_step.some
    enlarged = any(step.kind == "lowres" for step in degradation.steps)
    suffix = ".jpg" if jpeg_last else ".png"
    names = {view.name: _with_suffix(view.name, ".png" if enlarged else suffix) for view in scene.train}
    names |= {view.name: _with_suffix(view.name, ".png") for view in scene.test}
    _check_names(names)
    with new_folder(Path(out).resolve()) as root:
        train: dict[str, str | None] = {}
        steps: dict[str, list[Record]] = {}
        for view, result in degraded_views(scene, degradation, seed):
            name, last = names[view.name], result.image if result.low is None else result.low
            content = result.jpeg if jpeg_last and result.jpeg is not None else last
            steps[name] = result.records
            if enlarged:
                small = _with_suffix(name, suffix)
                train[name] = f"low/{small}"
                _store(root / "low", small, content)
                _store(root / "images", name, result.image)
            else:
                train[name] = None
                _store(root / "images", name, content)
        for view in scene.test:
            _store(root / "images", names[view.name], view.image)
        views = {names[view.name]: view for view in (*scene.train, *scene.test)}
        for name, view in views.items():
            if view.mask is not None:
                _store(root / "masks", _with_suffix(name, ".png"), view.mask.astype(np.uint8) * 255)
        world = scene.world
        cameras = {
            name: replace(view.camera, viewmat=world.viewmat_out(view.camera.viewmat))
            for name, view in views.items()
        }
        seen = None
        if scene.seen is not None:
            seen = {names[name]: rows for name, rows in scene.seen.items() if name in names}
        error = 0.0 if scene.tracks is None else scene.tracks.error
        points = world.out(scene.points)
        write_colmap(root / "sparse" / "0", cameras, points, scene.point_colors, seen, error)
        stored = "stored as the last step's JPEG files" if jpeg_last else "clipped and rounded to 8-bit PNGs"
        if enlarged:
            stored += " in low and enlarged to 8-bit PNGs"
        write_degraded_folder(
            root,
            DegradedFolder(
                kind=str(degradation),
                seed=seed,
                train=train,
                held_out=[names[view.name] for view in scene.test],
                notes=[*scene.notes, _note(scene, degradation, seed, stored)],
                steps=steps,
            ),
        )


def degraded_views(scene: Scene, degradation: Degradation, seed: int) -> Iterator[tuple[View, Degraded]]:
    """The training views with what becomes of their photos, as `degrade_scene` says."""
    if seed < 0:
        raise ValueError(f"seed is {seed}, wanted at least 0")
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    rngs = {view.name: np.random.default_rng([seed, k]) for k, view in enumerate(views)}
    factors = _factors(scene, seed) if degradation.partial else {}
    film = any(step.kind in FILMS for step in degradation.steps)
    for group in [views] if film else [[view] for view in scene.train]:
        for view in group:
            if film and view.image.shape != views[0].image.shape:
                sizes = " and ".join(f"{v.image.shape[1]} x {v.image.shape[0]}" for v in (views[0], view))
                raise ValueError(
                    f"photo {view.name!r}: a film has one size, but {views[0].name!r} and it have {sizes} px"
                )
        try:
            results = degrade_sequence(
                [view.image for view in group],
                degradation,
                [rngs[view.name] for view in group],
                [factors.get(view.name) for view in group],
            )
        except ValueError as error:
            raise ValueError(f"photo {group[0].name!r}: {error}") from error
        found = {view.name: result for view, result in zip(group, results, strict=True)}
        yield from ((view, found[view.name]) for view in (scene.train if film else group))


def _factors(scene: Scene, seed: int) -> dict[str, float]:
    """The half of the training photos that `some` steps hit, each with its factor."""
    names = sorted(view.name for view in (*scene.train, *scene.test))
    rng = np.random.default_rng([seed, 0, 1])  # a photo's own generator has two words
    places = dict(zip(names, rng.random(len(names)), strict=True))
    factors = dict(zip(names, rng.uniform(0.5, 1.5, len(names)).tolist(), strict=True))
    train = sorted((view.name for view in scene.train), key=lambda name: places[name])
    return {name: factors[name] for name in train[: (len(train) + 1) // 2]}


def _note(scene: Scene, degradation: Degradation, seed: int, stored: str) -> str:
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.train})
    exact = {str(degradation.for_width(*size)): size[0] for size in sizes}
    kind = str(degradation)
    if set(exact) != {kind}:
        kind += f" ({', '.join(f'{steps} at a width of {width} px' for steps, width in exact.items())})"
    photos = f"all training photos ({len(scene.train)})"
    if degradation.partial:
        hit = f"{len(_factors(scene, seed))} of {len(scene.train)}"
        whole = all(step.some for step in degradation.steps)
        photos = f"{hit} training photos" if whole else f"{photos}, the steps of some: {hit}"
    return (
        f"degradation {kind}, seed {seed}: {photos}, {stored}; held-out photos ({len(scene.test)}) are clean"
    )


def _with_suffix(name: str, suffix: str) -> str:
    """The photo's name with this suffix; its own only goes if it is a photo's."""
    own = Path(name).suffix
    stem = name[: -len(own)] if own.lower() in PHOTO_SUFFIXES else name
    return stem + suffix


def _check_names(names: dict[str, str]) -> None:
    """ValueError unless the new names are in the order of the old ones and differ up to the suffix."""
    stems = {_with_suffix(name, "") for name in names}
    new = [names[name] for name in sorted(names)]
    if len(stems) < len(names) or new != sorted(new):
        raise ValueError(
            "the photos' names must differ, and be in the same order, when their suffixes are replaced by "
            f".jpg or .png; they are {some(sorted(names))}"
        )


def _store(folder: Path, name: str, content: bytes | NDArray[Any]) -> None:
    """Write a file's bytes, or pixels [H, W, 3] or [H, W] as a PNG; floats are clipped and rounded."""
    with atomic_path(inside(folder, name, "the photo's name")) as tmp:
        if isinstance(content, bytes):
            tmp.write_bytes(content)
        else:
            Image.fromarray(content if content.dtype == np.uint8 else to_uint8(content)).save(tmp, "PNG")
