"""What several commands share: the options that name a scene, and the reading of it."""

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
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hqgs.base.files import CONFIG, read_json
from hqgs.base.interrupt import ENDINGS
from hqgs.cli.errors import fail
from hqgs.photos.formula import grammar
from hqgs.scene.names import existing_folder, is_room
from hqgs.scene.photo_files import film_at

if TYPE_CHECKING:
    from hqgs.cli.progress import LoadingScreen
    from hqgs.model.gaussians import Gaussians
    from hqgs.scene.camera_files import RunCameras
    from hqgs.scene.scene import Scene

SceneName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
Factor = Annotated["float | None", tyro.conf.arg(metavar="F", help_behavior_hint="")]
Number = Annotated["int | None", tyro.conf.arg(metavar="N", help_behavior_hint="")]
Apart = Annotated["tuple[str, str, float] | None", tyro.conf.arg(metavar="A B METRES", help_behavior_hint="")]
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
KINDS = (
    f"{grammar()}, some:KIND (half of the photos only), several joined by + in their order, mixed, or none"
)
Kind = Annotated[str, tyro.conf.arg(metavar="KIND", help=f"what happens to the training photos: {KINDS}")]


@dataclass(frozen=True, kw_only=True)
class Photos:
    """Which photos, and at which size."""

    scene: SceneName
    """A folder with photos, a film, a scene that other programs made (COLMAP, LLFF, nerfstudio, ...), or
    a scene that is built in: embedded, sparse, true-shake, true-defocus, true-exposure, true-devices,
    true-crowd or true-panorama."""
    downscale: Factor = None
    """Divide the photos' sides by F."""


def ready(scene: str) -> None:
    """Tell a wrong path at once; then load what takes seconds, after which SIGTERM counts as Ctrl-C."""
    if not is_room(scene) and film_at(scene) is None:
        existing_folder(scene)
    warnings.filterwarnings(
        "ignore", category=FutureWarning, message=".*torch.jit"
    )  # of libraries, not of us
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


def cameras_beside(source: Path) -> RunCameras | None:
    """The cameras of a run's folder, or of the folder that a scene file lies in; None where none are."""
    from hqgs.scene.camera_files import CAMERAS, load_cameras

    folder = source if source.is_dir() else source.parent
    return load_cameras(folder) if (folder / CAMERAS).is_file() else None


def config_part(folder: Path, name: str) -> dict[str, Any]:
    """A part of config.json in a run's folder; empty where none is, or it is another program's."""
    path = folder / CONFIG
    config = read_json(path) if path.is_file() else None
    part = config.get(name) if isinstance(config, dict) else None
    return part if isinstance(part, dict) else {}


def check_background(background: Sequence[float]) -> None:
    """ValueError for what is no colour, such as levels of 255."""
    if not all(0 <= value <= 1 for value in background):
        given = " ".join(f"{value:g}" for value in background)
        raise ValueError(f"--background is {given}, wanted three numbers in 0..1; 1 is white")


def load(photos: Photos, screen: LoadingScreen) -> Scene:
    """The scene of a command that takes no more than the photos."""
    from hqgs.scene.source import load as load_source  # here: it loads torch

    downscale = 1.0 if photos.downscale is None else photos.downscale
    stage = screen.stage
    return load_source(photos.scene, downscale=downscale, skip_unreadable=False, points=False, on_stage=stage)
