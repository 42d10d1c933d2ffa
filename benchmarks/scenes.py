"""The scenes of the studies: read, split for tuning, degraded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hqgs.base.files import is_room
from hqgs.photos.formula import parse_degradation
from hqgs.scene.builtin import embedded_scene, room
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.formats.degradation_json import FILE
from hqgs.scene.formats.llff import hold_marker
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene, View

EMBEDDED = Path("embedded")  # stands for the built-in scene
BUILT_IN = {EMBEDDED: None, Path("embedded-matte"): 0.0, Path("embedded-glossy"): 1.0}  # gloss
SMALLEST = 8  # pixels: the sides of the built-in scenes' photos
VALIDATE_EVERY = 7  # every 7th training photo


def load_scenes(
    sources: Sequence[Path], downscale: float, embedded: tuple[int, int, int], cache: Path, validate: bool
) -> list[Scene]:
    """The clean scenes of these folders; `embedded` is the built-in ones' width, height and views.

    With `validate` the held-out views are gone: see `validation_split`. The built-in scenes are kept in
    `cache`. Raises FileNotFoundError for a missing folder, ValueError for a bad one, for two of one name, for
    one that `hqgs degrade` wrote, and for degraded training photos where clean ones are to validate on.
    """
    names = [source.resolve().name for source in sources]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"two scenes are called {twice[0]!r}; the tables could not tell them apart")
    scenes = []
    for source in sources:
        if source in BUILT_IN:
            width, height = (round(size / downscale) for size in embedded[:2])
            if min(width, height) < SMALLEST:
                most = min(embedded[:2]) / SMALLEST
                raise ValueError(f"downscale must be in 1..{most:g} for {source}, got {downscale}")
            folder = cache / f"{source}_{width}x{height}_{embedded[2]}"
            made = embedded_scene(folder, width, height, num_views=embedded[2], gloss=BUILT_IN[source])
            scene = replace(made, name=str(source))
        elif is_room(source):
            scene = replace(room(source, cache / f"{source}_x{downscale:g}", downscale), name=str(source))
        else:
            if (source / FILE).is_file():
                raise ValueError(f"{source} holds degraded photos; give the folder of the clean ones")
            if validate and hold_marker(source) is not None:
                raise ValueError(
                    f"{source}: the training photos are degraded, so there is no clean one to validate on"
                )
            scene = load_scene(source, downscale=downscale)
        if not scene.test:
            raise ValueError(f"scene {scene.name!r} has no held-out view to judge by")
        scenes.append(validation_split(scene) if validate else scene)
    return scenes


def validation_split(scene: Scene) -> Scene:
    """A scene to tune on: every 7th training photo is held out, and no test view is left in it.

    ValueError where no photo would be left to train on.
    """
    train = [view for k, view in enumerate(scene.train) if k % VALIDATE_EVERY]
    if not train:
        raise ValueError(
            f"scene {scene.name!r} has {len(scene.train)} training photos, too few to hold any out"
        )
    held = scene.train[::VALIDATE_EVERY]
    note = (
        f"for tuning: every {VALIDATE_EVERY}th training photo ({len(held)}) is held out, "
        f"the {len(scene.test)} test views are not used; the points stem from all training photos"
    )
    return replace(scene, train=train, test=held, notes=[*scene.notes, note])


def degraded(scene: Scene, degradation: str, seed: int) -> Scene:
    """Degraded training photos, clean held-out ones."""
    kind = parse_degradation(degradation)
    return degrade_scene(scene, kind, seed) if kind.steps else scene


def degraded_view(scene: Scene, view: View, degradation: str, seed: int) -> View:
    """A view with the photo that `degraded` would give it if the scene trained on it and no other."""
    others = [other for other in (*scene.train, *scene.test) if other.name != view.name]
    return degraded(replace(scene, train=[view], test=others), degradation, seed).train[0]
