"""Scenes as users name them: a folder, a film or the built-in room.

The command line and `import hqgs` both call what is here; the former scales large photos down by default.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hqgs.base.files import CONFIG
from hqgs.base.stages import OnStage, silent
from hqgs.photos.formula import parse_degradation
from hqgs.scene.builtin import room
from hqgs.scene.constants import TEST_EVERY
from hqgs.scene.degrade import degrade_scene
from hqgs.scene.film import check_film, film_frames
from hqgs.scene.known_points import with_points
from hqgs.scene.load import check_names, coarsely, load_pictures, load_scene
from hqgs.scene.metres import distance_of, in_metres
from hqgs.scene.names import KEPT, is_room
from hqgs.scene.photo_files import film_at
from hqgs.scene.restore import check_weights, restore_scene
from hqgs.scene.same_run import check_same
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.reconstruct import sfm_scene
from hqgs.scene.tags import by_tags, check_tag_size
from hqgs.scene.upright import as_asked, direction_of, with_up


def load(
    path: str | Path,
    *,
    downscale: float = 1.0,
    test_every: int = 8,
    sfm: bool = False,
    degrade: str = "none",
    seed: int = 0,
    restore: str | Path | None = None,
    skip_unreadable: bool = True,
    cache: str | Path | None = None,
    longest: int | None = None,
    coarse: bool | None = None,
    frames: int | None = None,
    distance: Sequence[str | float] | None = None,
    tag_size: float | None = None,
    up: Sequence[float] | None = None,
    points: bool = True,
    on_stage: OnStage = silent,
) -> Scene:
    """Read a scene into memory: training views, held-out views, pinhole cameras, starting points.

    Args:
        path: a folder of photos alone, or a film: COLMAP finds cameras and points. Or a COLMAP, LLFF,
            Deblur-NeRF, nerfstudio, instant-ngp or Blender folder, or a scene that is built in
            (`hqgs.scene.builtin.room`): "embedded", "sparse", "true-shake", "true-defocus", "true-exposure",
            "true-devices", "true-crowd" or "true-panorama".
        downscale: divide the photos' sides by this, at least 1.
        test_every: hold out each view whose place in the sorted names is a multiple of this; 0: none. A
            folder that names its own held-out views keeps them; so does the embedded scene (every 8th).
        sfm: take cameras and points from the training photos, by COLMAP, in a folder that has its own too.
        degrade: what happens to the training photos first, as `hqgs.degrade` reads it.
        seed: of the degradation, and of what a built-in camera does.
        restore: weights of an image network that the training photos go through at last.
        skip_unreadable: leave out photos that cannot be read, or are of another shape than their camera, as
            long as half of the photos to train on, and of those held out, remain; `Scene.notes` names them.
            False: an error.
        cache: a folder that keeps what takes long, for the next call: COLMAP's models, the frames of a film,
            the embedded scene.
        longest: px; scale the photos down further where a side is longer, or where all photos together
            would take more than 4 GB of memory.
        coarse: whether COLMAP may look at photos alone coarsely, which is faster, to find their cameras;
            None: where `longest` is at most 640.
        frames: how many of a film; None: two a second, 30 to 90.
        distance: (A, B, metres) between the cameras of two photos, or points "x,y,z" in the frame of the
            files: what is written is in metres then.
        tag_size: metres; the width of the black square of printed tags (AprilTag 36h11, ArUco) that photos
            show: what is written is in metres then, and upright where a tag lies (the extra `tags`).
        up: x, y, z in the frame of the files; None: as photos, tags or GPS tell it.
        points: where the files have cameras and no points, let COLMAP find points, and seek up. False, for a
            scene that is only looked at: random ones, and up as the photos were held.
        on_stage: hears what is being done, and how far it is.

    Returns:
        Photos [H, W, 3], sRGB, uint8 (float32 where they were degraded or restored from that); world units
        and frame are those of the files, cameras are in the OpenCV frame.

    Raises:
        FileNotFoundError: a folder, photo or file of weights that is not there.
        ValueError: anything else that is wrong; the message names the file or the photo.
    """
    origin = {
        "path": str(path if is_room(path) else Path(path).expanduser().resolve()),
        "downscale": downscale,
        "test_every": test_every,
        "sfm": sfm,
        "degrade": degrade,
        "seed": seed,
        "restore": None if restore is None else str(Path(restore).resolve()),
        "skip_unreadable": skip_unreadable,
        "longest": longest,
        "coarse": coarse,
        "frames": frames,
        "distance": None if distance is None else [*distance],
        "tag_size": tag_size,
        "up": None if up is None else [*up],
    }
    apart = None if distance is None else distance_of(distance)
    if tag_size is not None:
        check_tag_size(tag_size, distance)
    asked = None if up is None else direction_of(up)
    degradation = parse_degradation(degrade)
    if restore is not None:
        check_weights(restore)
    kept = None if cache is None else Path(cache)
    models = None if kept is None else kept / KEPT
    if frames is not None:
        check_film(path)
    if is_room(path):
        if not downscale >= 1:
            raise ValueError(f"downscale must be at least 1, got {downscale}")
        if test_every != TEST_EVERY:
            raise ValueError(f"test_every is {test_every}, but built-in scenes hold out every {TEST_EVERY}th")
        scene = room(path, None if kept is None else kept / "scene", downscale, seed)
    else:
        with ExitStack() as stack:
            notes, name = list[str](), None
            if (film := film_at(path)) is not None:
                name = film.stem
                folder = kept or Path(stack.enter_context(TemporaryDirectory(prefix="hqgs-film-")))
                path, note = film_frames(film, folder / "frames", frames, on_stage)
                notes.append(note)
            if apart is not None:
                check_names(path, downscale, apart)
            scene = load_scene(
                path,
                downscale,
                test_every=test_every,
                skip_unreadable=skip_unreadable,
                keep_sfm=models,
                longest=longest,
                on_stage=on_stage,
                sfm=sfm,
                coarse=coarse,
            )
            scene = replace(scene, name=name or scene.name, notes=[*notes, *scene.notes])
    if degradation.steps:
        scene = degrade_scene(scene, degradation, seed)
    if sfm and (scene.source != "photos" or degradation.steps):
        scene = sfm_scene(scene, models, on_stage)
    scene = scene if restore is None else restore_scene(scene, restore)
    if points:
        scene = with_points(scene, models, on_stage)
        scene = scene if is_room(path) or asked is not None else with_up(scene)
    scene = scene if apart is None else in_metres(scene, apart)
    scene = scene if tag_size is None else by_tags(scene, tag_size)
    scene = scene if asked is None else as_asked(scene, asked)
    return replace(scene, origin=origin)


def load_again(run: str | Path, on_stage: OnStage = silent) -> Scene:
    """The scene that the run in a folder was trained on, from the photos, where they still lie.

    ValueError where its config.json does not tell, or the photos have changed since (`check_same`),
    FileNotFoundError where they are gone.
    """
    path = Path(run) / CONFIG
    try:
        origin = json.loads(path.read_text(encoding="utf-8"))["scene"]
        origin.pop("features", None)  # which older versions could choose
        scene = load(**origin, cache=run, on_stage=on_stage)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"the photos of the run {run} are not known: {error}") from error
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} does not tell which scene was trained: {error!r}") from error
    check_same(scene, Path(run), split=True)
    return scene


def finding(origin: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Options of `load` by which photos alone, or a film, get the cameras that a run has.

    `origin`: `Scene.origin` of what it was trained on, as its config.json has it; empty: not known.
    """
    found = {} if film_at(path) is None else {"frames": origin.get("frames")}
    return found | {"coarse": coarsely(origin.get("longest"), origin.get("coarse"))}


def pictures(path: str | Path, *, downscale: float = 1.0, longest: int | None = None) -> Scene:
    """What `hqgs.diagnose` needs of a folder: as `load`, but photos alone, or a film, are given no poses.

    Of photos alone some are read, spread over the folder.
    """
    if not is_room(path):
        with TemporaryDirectory(prefix="hqgs-film-") as name:
            film = film_at(path)
            source = path if film is None else film_frames(film, Path(name))[0]
            if (scene := load_pictures(source, downscale, longest=longest)) is not None:
                return scene if film is None else replace(scene, name=film.stem)
    return load(path, downscale=downscale, longest=longest, points=False)


def degrade(scene: Scene, kind: str, *, seed: int = 0) -> Scene:
    """The scene with degraded training photos (float32, 1 is white); held-out ones stay as they are.

    Args:
        kind: jpeg:QUALITY, noise:SIGMA, lowres:FACTOR, blur[:SIGMA], defocus[:RADIUS], motion[:LENGTH] (white
            is 255, lengths are in px); shake[:PX], exposure[:EV], phone[:EV], crowd[:N], chat[:SIDE] (each
            photo in its own way), video[:CRF] (all photos as one film; needs the extra `video`), some:KIND
            (half of the photos only); several joined by + in their order, mixed, or none.
        seed: of everything random. Each photo has its own numbers, whatever the others are.

    Raises ValueError for an unknown kind, a value out of range or a photo that is too small for it.
    """
    return degrade_scene(scene, parse_degradation(kind), seed)
