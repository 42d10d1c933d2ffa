"""Scenes as users name them: a folder, a film or the built-in room.

The command line and `import hqgs` both call what is here; the former scales large photos down by default.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hqgs.base.options import called_with, given
from hqgs.base.stages import OnStage, silent
from hqgs.base.state import own_state
from hqgs.photos.formula import parse_degradation
from hqgs.scene.constants import PATH_SIZE, TEST_EVERY
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.film import check_film, film_frames
from hqgs.scene.known_points import with_points
from hqgs.scene.load import check_names, coarsely, load_pictures, load_scene
from hqgs.scene.metres import Distance, distance_of, in_metres
from hqgs.scene.names import EMBEDDED, KEPT, is_room
from hqgs.scene.options import LoadOptions
from hqgs.scene.photo_files import film_at
from hqgs.scene.restore import check_weights, restore_scene
from hqgs.scene.room import embedded_scene
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.reconstruct import sfm_scene
from hqgs.scene.upright import direction_of, told_up, with_up


@dataclass(frozen=True, kw_only=True)
class LoadCall(LoadOptions):
    """The arguments of `load`."""

    cache: str | Path | None = None
    points: bool = True
    on_stage: OnStage = silent


@called_with(LoadCall)
@own_state(grad=True)
def load(call: LoadCall) -> Scene:
    """Read a scene into memory: training views, held-out views, pinhole cameras, starting points.

    Args:
        path: a folder of photos without cameras, or a film: COLMAP finds cameras and points. Or a COLMAP,
            LLFF, Deblur-NeRF, nerfstudio, instant-ngp or Blender folder, or "embedded", a built-in room.
        downscale: divide width and height of the photos by this, at least 1 (1).
        test_every: hold out each view whose place in the sorted names is a multiple of this (8); 0: none. A
            folder that names its own held-out views keeps them; so does the embedded scene (every 8th).
        sfm: find cameras and points from the training photos by COLMAP, even if the folder has some.
        degrade: how to degrade the training photos, as `hqgs.degrade` reads it (none).
        seed: of the degradation (0).
        restore: weights of an image network that restores the training photos, after `degrade`.
        skip_unreadable: leave out photos that cannot be read, or have another aspect ratio than their
            camera, as long as half of the training photos, and of the held-out ones, remain; `Scene.notes`
            names them. False: an error (True).
        cache: a folder that keeps COLMAP's models and the frames of a film for the next call.
        longest: px; scale the photos down further where a side is longer, or where all photos together
            would take more than 4 GB of memory.
        coarse: whether COLMAP uses coarse features only, which is faster; None: if `longest` is at most 640.
        frames: how many of a film; None: two per second, 30 to 90.
        distance: (A, B, metres) between the cameras of two photos, or points "x,y,z" in the frame of the
            files: files are then written in metres.
        up: x, y, z in the frame of the files; None: measured in photos or by GPS.
        points: if the files have cameras but no points, find points by COLMAP, and measure up. False, for a
            scene that is only shown: random points, and up as the photos were held.
        on_stage: is called with what is done, and how far it is.

    Returns:
        Photos [H, W, 3], sRGB, uint8 (float32 where they were degraded or restored from that); world units
        and frame are those of the files, cameras are in the OpenCV frame.

    Raises:
        FileNotFoundError: a folder, photo or file of weights is missing.
        ValueError: anything else that is wrong; the message names the file or the photo.
    """
    named = is_room(call.path)
    path = str(call.path) if named else str(Path(call.path).expanduser().resolve())
    scene = load_as(replace(call, path=path), call.cache, call.points, call.on_stage)
    if str(call.path) == EMBEDDED and not named:
        note = f"{path}: the folder is used, not the built-in scene of that name"
        scene = replace(scene, notes=[note, *scene.notes])
    return scene


def load_as(
    asked: LoadOptions, cache: str | Path | None = None, points: bool = True, on_stage: OnStage = silent
) -> Scene:
    """The scene of these options, again where a run has kept them; `load` says the rest."""
    named = not Path(asked.path).is_absolute()
    apart = None if asked.distance is None else distance_of(asked.distance)
    up = None if asked.up is None else direction_of(asked.up)
    degradation = parse_degradation(given(asked.degrade, "none"))
    if asked.restore is not None:
        check_weights(asked.restore)
    if asked.frames is not None:
        check_film(asked.path)
    kept = None if cache is None else Path(cache)
    models = None if kept is None else kept / KEPT
    scene = _room(asked) if named else _read(asked, kept, models, apart, on_stage)
    if degradation.steps:
        scene = degrade_scene(scene, degradation, given(asked.seed, 0))
    if asked.sfm and (scene.source != "photos" or degradation.steps):
        scene = sfm_scene(scene, models, on_stage)
    scene = scene if asked.restore is None else restore_scene(scene, asked.restore)
    if points:
        scene = with_points(scene, models, on_stage)
        scene = scene if named or up is not None else with_up(scene)
    scene = scene if apart is None else in_metres(scene, apart)
    scene = scene if up is None else told_up(scene, up, "as given")
    kept_as = {option.name: getattr(asked, option.name) for option in fields(LoadOptions)}
    kept_as |= {} if asked.restore is None else {"restore": str(Path(asked.restore).resolve())}
    return replace(scene, origin=json.loads(json.dumps(kept_as)))


def _room(asked: LoadOptions) -> Scene:
    """The built-in scene."""
    if asked.path != EMBEDDED:
        raise ValueError(f"there is no built-in scene {asked.path!r}")
    downscale, every = given(asked.downscale, 1.0), given(asked.test_every, TEST_EVERY)
    if not downscale >= 1:
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    if every != TEST_EVERY:
        raise ValueError(f"test_every is {every}, but the built-in scene holds out every {TEST_EVERY}th")
    width, height = (round(side / downscale) for side in PATH_SIZE)
    return embedded_scene(width, height)


def _read(
    asked: LoadOptions, kept: Path | None, models: Path | None, apart: Distance | None, on_stage: OnStage
) -> Scene:
    """The scene of a folder or a film."""
    path, notes, name = Path(asked.path), list[str](), None
    with ExitStack() as stack:
        if (film := film_at(path)) is not None:
            name = film.stem
            folder = kept or Path(stack.enter_context(TemporaryDirectory(prefix="hqgs-film-")))
            path, note = film_frames(film, folder / "frames", asked.frames, on_stage)
            notes.append(note)
        if apart is not None:
            check_names(path, asked.downscale, apart)
        options = {option.name: getattr(asked, option.name) for option in fields(LoadOptions)}
        options |= {"path": path, "skip_unreadable": given(asked.skip_unreadable, True)}
        scene = load_scene(**options, keep_sfm=models, on_stage=on_stage)
    return replace(scene, name=name or scene.name, notes=[*notes, *scene.notes])


def finding(origin: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Options of `load` by which photos alone, or a film, get the cameras that a run has.

    `origin`: `Scene.origin` of what it was trained on, as its config.json has it; empty: not known.
    """
    found = {} if film_at(path) is None else {"frames": origin.get("frames")}
    return found | {"coarse": coarsely(origin.get("longest"), origin.get("coarse"))}


def pictures(
    path: str | Path,
    *,
    downscale: float | None = None,
    longest: int | None = None,
    test_every: int | None = None,
) -> Scene:
    """What `hqgs.diagnose` needs of a folder: as `load`, but photos alone, or a film, are given no poses.

    Of photos alone some are read, spread over those that `test_every` does not hold out (None: over all).
    """
    if not is_room(path):
        with TemporaryDirectory(prefix="hqgs-film-") as name:
            film = film_at(path)
            source = path if film is None else film_frames(film, Path(name))[0]
            scene = load_pictures(source, downscale, longest=longest, test_every=test_every or 0)
            if scene is not None:
                return scene if film is None else replace(scene, name=film.stem)
    return load(path, downscale=downscale, longest=longest, test_every=test_every, points=False)


@own_state(grad=True)
def degrade(scene: Scene, kind: str, *, seed: int = 0) -> Scene:
    """The scene with degraded training photos (float32, 1 is white); held-out ones stay as they are.

    Args:
        kind: jpeg:QUALITY, noise:SIGMA, lowres:FACTOR, blur[:SIGMA], defocus[:RADIUS], motion[:LENGTH] (white
            is 255, lengths are in px), some:KIND (half of the photos only); several joined by + in their
            order, mixed, or none.
        seed: of everything random. Each photo has its own numbers, whatever the others are.

    Raises ValueError for an unknown kind, a value out of range or a photo that is too small for it.
    """
    return degrade_scene(scene, parse_degradation(kind), seed)
