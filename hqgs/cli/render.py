"""`hqgs render`: pictures and films of a trained scene."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hqgs.base.options import Color, Factor, Number, Size, Unsaid, Vector, choice, given
from hqgs.base.text import some
from hqgs.cli.scenes import check_above, check_background, tell_read
from hqgs.evaluation.run_folder import RunFolder
from hqgs.photos.suffixes import PHOTO_SUFFIXES

if TYPE_CHECKING:
    from hqgs.model.gaussians import Gaussians
    from hqgs.scene.scene import Camera
    from hqgs.show.trust import Trust

PATHS = ("cameras", "orbit")
PICTURE = re.compile(r"\d{5}\.png|\d{3}_.*\.png")  # as they are named in a folder


@dataclass(frozen=True, kw_only=True)
class Render:
    """Options of `hqgs render`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """The folder of a run, or a scene file."""
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """PATH.mp4, PATH.gif, PATH.png, or a folder for pictures."""
    views: Annotated[str | None, tyro.conf.arg(metavar="WHICH", help_behavior_hint="")] = None
    """Render the photos' views instead of a path: train, test, all, or names separated by commas."""
    path: Annotated[str | None, tyro.conf.arg(metavar="KIND"), Unsaid] = None
    """cameras (the default: a smooth path through the training cameras, with cuts at large gaps), orbit, or
    the JSON file of a camera path by the viewer or nerfstudio. A scene file without cameras gets an orbit."""
    frames: Number = None
    """Number of frames, for cameras and orbit (240)."""
    fps: Factor = None
    """Frames per second (30, or what the path file says)."""
    size: Size = None
    """Size in pixels (as the cameras have)."""
    show: Annotated[str, choice("color", "depth", "alpha", "trust"), Unsaid] = "color"
    """What to render (color). trust: an error bound that 9 of 10 pixels stay below, by the run's photos."""
    look: Annotated[str | None, tyro.conf.arg(metavar="PHOTO", help_behavior_hint="")] = None
    """Render with the exposure of this photo of the run, and its camera's vignetting and response, if they
    were learned (the mean of all photos)."""
    background: Color = None
    """Background colour R G B; 1 is white (that of the run, or black)."""
    up: Vector = None
    """Up direction of an orbit (that of the cameras or of the scene file; else 0 -1 0)."""


OPTIONS = Render


def run(options: Render) -> int:
    """Render, and say what was written; return the exit code (0 done, 1 failed, 2 bad input)."""
    source, out, size = options.source, options.out, options.size
    from hqgs.model.formats.files import scene_file  # here: --help waits for no array

    file, run = scene_file(source), RunFolder.open(source)
    _check(options, run)
    from hqgs.evaluation.held_out import look_of
    from hqgs.model.gaussians import Gaussians
    from hqgs.scene.paths import with_size
    from hqgs.show.frames import check_frames, render_frames, written_size  # here: they load torch

    gaussians = Gaussians.load(file)
    tell_read(gaussians)
    names, cameras, rate = _cameras(options, gaussians, run)
    if size is not None:
        cameras = [with_size(camera, *size) for camera in cameras]
    if out.suffix.lower() == ".png" and options.views is None:
        cameras = cameras[:1]
    fps = given(options.fps, rate)
    check_frames(cameras, out, fps, options.show)
    look = None if options.look is None else look_of(run.folder, options.look)
    trust = _trust(options, gaussians, run) if options.show == "trust" else None  # it may take minutes
    started = time.perf_counter()
    render_frames(
        gaussians,
        cameras,
        out,
        fps=fps,
        show=options.show,
        background=given(options.background, run.background),
        names=names,
        progress=_progress if sys.stderr.isatty() else None,
        trust=trust,
        look=look,
    )
    seconds = time.perf_counter() - started
    kinds = sorted({written_size(out, camera.width, camera.height) for camera in cameras})
    px = f"{kinds[0][0]} x {kinds[0][1]} px" if len(kinds) == 1 else "several sizes"
    many = f"{len(cameras)} frames" if len(cameras) > 1 else "1 frame"
    print(f"{out}: {many}, {px}, {len(gaussians)} Gaussians, {len(cameras) / seconds:.1f} frames/s")
    return 0


def _check(options: Render, run: RunFolder) -> None:
    """What the options alone tell. ValueError."""
    for name in ("path", "frames", "up"):
        if options.views is not None and getattr(options, name) is not None:
            raise ValueError(
                f"--{name} is for paths, and --views uses the photos' cameras: give only one of them"
            )
    if options.look is not None and options.show != "color":
        raise ValueError(f"--look is for --show color, and --show is {options.show}")
    if options.background is not None:
        check_background(options.background)
    check_above(options.out)
    _check_folder(run, options.out)


def _check_folder(run: RunFolder, out: Path) -> None:
    """ValueError where pictures would lie among photos: the next run on these would take them for some."""
    if not out.is_dir():
        return
    held = sorted(path.name for path in out.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES)
    path = run.loaded.get("path")
    own = path is not None and out.resolve() in (Path(path), Path(path, "images"))
    if photos := [name for name in held if own or not PICTURE.fullmatch(name)]:
        raise ValueError(f"--out {out} holds photos ({some(photos)}): name another folder for the renders")


def _cameras(
    options: Render, gaussians: Gaussians, run: RunFolder
) -> tuple[list[str] | None, list[Camera], float]:
    """Names of the pictures, if they have any, the cameras, and frames per second."""
    from hqgs.model.gaussians import orbit
    from hqgs.photos.video import FPS
    from hqgs.scene.camera_files import load_path, moved, picked
    from hqgs.scene.paths import UP, camera_path

    source, views, path, frames = options.source, options.views, options.path or PATHS[0], options.frames
    known = gaussians.along(run.cameras)
    count = given(frames, 240)
    if views is not None:
        if known is None:
            raise ValueError(f"{source} has no cameras.json, so its views are unknown: use --path orbit")
        held = {kind: [view for view in known.views if view.held_out == kind] for kind in (False, True)}
        chosen = picked(held[False], held[True], views, "the run")
        stems = [re.sub(r"[^A-Za-z0-9._-]+", "_", Path(v.name).stem).strip("._")[:80] for v in chosen]
        return [f"{k:03}_{stem}" for k, stem in enumerate(stems)], [v.camera for v in chosen], FPS
    if path not in PATHS:
        if frames is not None:
            raise ValueError("--frames is for cameras and orbit; a path file has its own frames")
        if options.up is not None:
            raise ValueError("--up is for an orbit; a path file has its own directions")
        if not Path(path).is_file():
            raise FileNotFoundError(f"--path is {path!r}: no such file, and none of: {', '.join(PATHS)}")
        own, rate = load_path(path)
        return None, [moved(camera, (known or gaussians).world, gaussians.moved) for camera in own], rate
    if known is None or not known.train:
        return None, orbit(gaussians, count, up=options.up or gaussians.world.up or UP), FPS
    if options.up is not None and path != "orbit":
        raise ValueError(
            "--up is for an orbit (--path orbit); a path through the cameras is level as they are"
        )
    up = given(options.up, known.up)
    made = orbit(known.train, count, up=up) if path == "orbit" else camera_path(known.train, count, cuts=True)
    return None, made, FPS


def _trust(options: Render, gaussians: Gaussians, run: RunFolder) -> Trust:
    """What the photos of the run say; prints how right that is on held-out ones."""
    from hqgs.show.trust import measure_trust, trust_of

    known = gaussians.along(run.cameras)
    if known is None and gaussians.errors is None:
        raise ValueError(
            f"--show trust: {options.source} has neither cameras.json and photos/, as a run has, nor errors "
            "of its Gaussians, which hqgs export --trust writes"
        )
    trust = trust_of(gaussians, known)
    measured = measure_trust(trust)
    if measured is not None:
        print(f"trust: {measured}")
    elif known is not None:
        print("trust: not calibrated, as the run held out no photo: error bounds are those of other captures")
    return trust


def _progress(done: int, total: int) -> None:
    end = "\n" if done == total else ""
    print(f"\rframe {done} of {total}", end=end, file=sys.stderr, flush=True)
