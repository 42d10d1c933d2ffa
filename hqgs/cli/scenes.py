"""What several commands share: options that name a scene, its reading, and what lies where `--out` names."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hqgs.base.files import CHECKPOINT
from hqgs.base.interrupt import ENDINGS
from hqgs.base.options import Factor, Number, Unsaid, given
from hqgs.base.text import some
from hqgs.cli.errors import fail
from hqgs.scene.names import existing_folder, is_room
from hqgs.scene.photo_files import film_at, is_run, strangers
from hqgs.training.config import longest_side

if TYPE_CHECKING:
    from hqgs.cli.progress import LoadingScreen
    from hqgs.evaluation.run_folder import RunFolder
    from hqgs.model.gaussians import Gaussians
    from hqgs.scene.scene import Scene

SceneName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]


@dataclass(frozen=True, kw_only=True)
class Photos:
    """The photos, and their size."""

    scene: SceneName
    """A folder with photos, a film, a scene of another program (COLMAP, LLFF, nerfstudio, ...), or embedded,
    a built-in room."""
    downscale: Factor = None
    """Divide width and height of the photos by F."""


@dataclass(frozen=True, kw_only=True)
class MeasuredOptions:
    """A scene file, and the photos that it is measured on."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """The folder of a run, or a scene file of this or another program."""
    photos: Annotated[str | None, tyro.conf.arg(metavar="SCENE"), Unsaid] = None
    """Photos with their cameras, in the frame of the scene file (those of the run)."""
    downscale: Factor = None
    """Divide width and height of the photos of --photos by F (longer sides become 1600 px at most)."""
    test_every: Number = None
    """Hold out every N-th photo of --photos (as the run did; else 8, unless the scene has a split)."""


def ready(scene: str) -> None:
    """Tell a wrong path at once; then load what takes seconds, after which SIGTERM counts as Ctrl-C."""
    if not is_room(scene) and film_at(scene) is None:
        existing_folder(scene)
    print(f"reading {scene}", flush=True)
    warnings.filterwarnings("ignore", category=FutureWarning, message=".*torch.jit")  # of libraries
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _stop)  # packages that are half loaded take an exception for their own
    import_module("hqgs.pipeline")
    import_module("hqgs.scene.source")
    heed_endings()


def heed_endings() -> None:
    """From here on Ctrl-C and SIGTERM interrupt; at the latter pycolmap would print a stack trace."""
    if threading.current_thread() is threading.main_thread():
        for ending in ENDINGS:
            signal.signal(ending, signal.default_int_handler)


def _stop(number: int, frame: object) -> None:
    """End at once: nothing has been written yet."""
    fail(130, "stopped")
    os._exit(130)


def tell_notes(scene: Scene) -> None:
    """What a user must know of the photos before anything is done with them."""
    sizes = sorted({(view.camera.width, view.camera.height) for view in [*scene.train, *scene.test]})
    size = " and others".join([f"{sizes[-1][0]} x {sizes[-1][1]} px", ""][: len(sizes)])
    print(
        f"{scene.name}: {len(scene.train)} photos to train on, {len(scene.test)} held out to measure with, "
        f"{size}, {len(scene.points):,} points"
    )
    for note in scene.notes:
        print(f"  {note}")
    sys.stdout.flush()


def tell_read(gaussians: Gaussians) -> None:
    """What the reading of a scene file left out or changed."""
    for note in gaussians.notes:
        print(f"read: {note}", flush=True)


def check_background(background: Sequence[float]) -> None:
    """ValueError for what is no colour, such as levels of 255."""
    if not all(0 <= value <= 1 for value in background):
        given = " ".join(f"{value:g}" for value in background)
        raise ValueError(f"--background is {given}, wanted three numbers in 0..1; 1 is white")


def measured_scene(run: RunFolder, asked: MeasuredOptions, screen: LoadingScreen) -> Scene:
    """The photos that a scene file is measured with: those that are named, or those of its run.

    Where `test_every` is not said, those are held out that the run held out.
    """
    photos, source, test_every = asked.photos, asked.source, asked.test_every
    from hqgs.evaluation.run_folder import check_same  # here: they load torch
    from hqgs.scene.load import formats_of, scene_folder
    from hqgs.scene.source import finding, load

    if photos is None:
        if asked.downscale is not None or test_every is not None:
            raise ValueError(
                f"{source} is measured on the photos of its run: --downscale and --test-every need --photos"
            )
        return _heard(run.photos(screen.stage), screen)
    bare = film_at(photos) is not None or not (
        is_room(photos) or formats_of(scene_folder(photos)[0], asked.downscale or 1.0)
    )
    if bare and not run.config:
        raise ValueError(
            f"{photos} has no cameras, and newly found ones would not be in the frame of {source}: give the "
            "COLMAP or nerfstudio folder that it was trained on"
        )
    scene = load(
        photos,
        downscale=asked.downscale,
        longest=longest_side("standard", asked.downscale),
        test_every=given(test_every, run.loaded.get("test_every")),
        skip_unreadable=False,
        points=False,
        cache=run.folder if run.config else None,
        on_stage=screen.stage,
        **(finding(run.loaded, photos) if bare else {}),
    )
    if bare:
        check_same(scene, run, split=False)
    split = run.split(_heard(scene, screen))
    if test_every is None:
        return split
    if seen := sorted({view.name for view in scene.test} & {view.name for view in split.train}):
        screen.say(f"warning: --test-every holds out photos that the run was trained on: {some(seen)}")
    return scene


def _heard(scene: Scene, screen: LoadingScreen) -> Scene:
    """The scene, when its notes were said."""
    for note in scene.notes:
        screen.say(note)
    return scene


def check_out(out: Path, scene: str, resume: bool, overwrite: bool) -> list[str]:
    """Lines on what is there, for the user.

    ValueError or FileExistsError where the run cannot begin, or go on, in the folder `out`.
    """
    if (out / CHECKPOINT).exists():
        if resume or overwrite:
            return []
        raise FileExistsError(
            f"{out} holds a run: continue it with --resume, start again with --overwrite, or choose another "
            "--out"
        )
    if out.is_dir() and Path(scene).is_dir() and out.samefile(scene):
        raise ValueError(f"--out {out} is the folder of the photos: name another folder for the run")
    check_out_folder(out)
    begun = "a run without checkpoint: it starts again" if is_run(out) else "no run; a new one starts"
    lines = [f"--resume: {out} holds {begun}"] if resume else []
    if others := strangers(out):
        lines.append(
            f"--out {out} also holds other files ({some(others)}): the run writes its files beside them"
        )
    return lines


def check_out_file(out: Path, source: Path | None = None) -> None:
    """ValueError where `--out` cannot be a file: before the work, or its result, or the source, is lost."""
    if out.is_dir():
        raise ValueError(f"--out {out} is a folder: name the file to write")
    if source is not None and out.exists() and out.samefile(source):
        raise ValueError(
            f"--out is the source {source} itself: name another file, or what is left out would be lost"
        )
    check_above(out)


def check_out_folder(out: Path) -> None:
    """ValueError where `--out` cannot be a folder, new or not."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file: name a folder")
    check_above(out)


def check_above(out: Path) -> None:
    """ValueError where `--out` would lie below a file."""
    above = next(path for path in out.absolute().parents if path.exists())
    if not above.is_dir():
        raise ValueError(f"--out {out} is inside {above}, which is a file, not a folder")
