"""`hqgs render`: pictures and films of a trained scene."""

from __future__ import annotations

import argparse
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.model.formats.files import scene_file

if TYPE_CHECKING:
    from hqgs.scene.camera_files import RunCameras
    from hqgs.scene.scene import Camera

PATHS = ("cameras", "orbit")
SHOWN = ("color", "depth", "alpha")
FRAMES = 240


def run(
    source: Path,
    out: Path,
    *,
    views: str | None = None,
    path: str = PATHS[0],
    frames: int | None = None,
    fps: float | None = None,
    size: tuple[int, int] | None = None,
    show: str = SHOWN[0],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    up: tuple[float, float, float] | None = None,
) -> int:
    """Render, and say what was written; return the exit code (0 done, 1 failed, 2 bad input).

    Args:
        source: the folder of a run, or a scene file.
        out: ends in .mp4, .gif or .png, or is a folder for pictures.
        views: "train", "test", "all", or names of views with commas: the run's own views in place of a path.
        path: "cameras" (through the training cameras), "orbit", or the JSON file of a camera path.
        frames: of a path that is made here; None: 240.
        fps: frames per second; None: those of the path file, or 30.
        size: width and height, px; None: those of the cameras.
        show: "color", "depth" or "alpha".
        background: R, G, B behind everything.
        up: the direction that is up in a scene file without cameras; None: (0, -1, 0).
    """
    try:
        file = scene_file(source)
        from hqgs.export.frames import render_frames  # here: they load torch
        from hqgs.model.gaussians import Gaussians
        from hqgs.scene.paths import resized

        gaussians = Gaussians.load(file)
        names, cameras, rate = _cameras(source, gaussians, views, path, frames, up)
        if size is not None:
            cameras = [resized(camera, *size) for camera in cameras]
        if out.suffix.lower() == ".png" and views is None:
            cameras = cameras[:1]
        started = time.perf_counter()
        render_frames(
            gaussians,
            cameras,
            out,
            fps=rate if fps is None else fps,
            show=show,
            background=background,
            names=names,
            progress=_progress if sys.stderr.isatty() else None,
        )
    except BAD_INPUT as error:
        if isinstance(error, OSError) and error.strerror:  # the system's words alone do not help
            return fail(2, f"{out} cannot be written: {error.strerror}")
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{out}: {error}")
    seconds = time.perf_counter() - started
    kinds = sorted({(camera.width, camera.height) for camera in cameras})
    px = f"{kinds[0][0]} x {kinds[0][1]} px" if len(kinds) == 1 else "several sizes"
    many = f"{len(cameras)} frames" if len(cameras) > 1 else "1 frame"
    print(f"{out}: {many}, {px}, {len(gaussians)} Gaussians, {len(cameras) / seconds:.1f} frames/s")
    return 0


def _cameras(
    source: Path,
    gaussians: object,
    views: str | None,
    path: str,
    frames: int | None,
    up: tuple[float, float, float] | None,
) -> tuple[list[str] | None, list[Camera], float]:
    """Names of the pictures, if they have any, the cameras, and frames per second."""
    from hqgs.export.frames import FPS
    from hqgs.model.gaussians import Gaussians
    from hqgs.model.orbit import orbit
    from hqgs.scene.camera_files import load_path
    from hqgs.scene.paths import UP, camera_path

    assert isinstance(gaussians, Gaussians)
    known = _known(source)
    count = FRAMES if frames is None else frames
    if views is not None:
        if known is None:
            raise ValueError(f"{source} has no cameras.json, which says what its views are; use --path orbit")
        chosen = _chosen(known, views)
        return [_file_name(k, name) for k, (name, _) in enumerate(chosen)], [c for _, c in chosen], FPS
    if path not in PATHS:
        if frames is not None:
            raise ValueError("--frames is for paths that are made here; a path file has its own")
        if not Path(path).is_file():
            raise FileNotFoundError(f"--path is {path!r}: no such file, and none of: {', '.join(PATHS)}")
        return None, *load_path(path)
    if known is None or not known.train:
        return None, orbit(gaussians, count, up=UP if up is None else up), FPS
    made = orbit(known.train, count) if path == "orbit" else camera_path(known.train, count)
    return None, made, FPS


def _known(source: Path) -> RunCameras | None:
    """The cameras of a run's folder, or of the folder that a scene file lies in."""
    from hqgs.scene.camera_files import CAMERAS, load_cameras

    folder = source if source.is_dir() else source.parent
    return load_cameras(folder) if (folder / CAMERAS).is_file() else None


def _chosen(known: RunCameras, views: str) -> list[tuple[str, Camera]]:
    kinds = {"train": (False,), "test": (True,), "all": (False, True)}
    if views in kinds:
        found = [(v.name, v.camera) for v in known.views if v.held_out in kinds[views]]
        if not found:
            raise ValueError(f"--views {views}: the run has no such view")
        return found
    by_name = {v.name: v.camera for v in known.views}
    by_name |= {Path(v.name).stem: v.camera for v in known.views if Path(v.name).stem not in by_name}
    missing = [name for name in views.split(",") if name not in by_name]
    if missing:
        some = ", ".join(v.name for v in known.views[:3])
        raise ValueError(
            f"--views: the run has no view {missing[0]!r}; there are: train, test, all, {some}, ..."
        )
    return [(name, by_name[name]) for name in views.split(",")]


def _file_name(number: int, view: str) -> str:
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(view).stem).strip("._")[:80]
    return f"{number:03}_{stem}"


def _progress(done: int, total: int) -> None:
    end = "\n" if done == total else ""
    print(f"\rframe {done} of {total}", end=end, file=sys.stderr, flush=True)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command `render` and its options."""
    parser = commands.add_parser("render", help="pictures and films of a trained scene")
    parser.set_defaults(run=_run)
    add = parser.add_argument
    add("source", type=Path, metavar="SOURCE", help="folder of a run, or a scene file")
    add("--out", type=Path, required=True, metavar="PATH", help="PATH.mp4, PATH.gif, PATH.png or a folder")
    add("--views", metavar="WHICH", help="the run's own views: train, test, all, or names with commas")
    add(
        "--path",
        default=PATHS[0],
        metavar="KIND",
        help="cameras (a smooth way through the training cameras), orbit, or the JSON file of a camera path, "
        "of the viewer or of nerfstudio (%(default)s; a scene file without cameras gets an orbit)",
    )
    add("--frames", type=int, metavar="N", help=f"frames of the path ({FRAMES})")
    add("--fps", type=float, metavar="F", help="frames per second (30, or what the path file says)")
    add("--size", type=int, nargs=2, metavar=("W", "H"), help="in pixels (as the cameras have)")
    add("--show", choices=SHOWN, default=SHOWN[0], help="(%(default)s)")
    add("--background", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("R", "G", "B"), help="(0 0 0)")
    add("--up", type=float, nargs=3, metavar=("X", "Y", "Z"), help="of a scene without cameras (0 -1 0)")


def _run(args: argparse.Namespace) -> int:
    wanted = {name: value for name, value in vars(args).items() if name != "run"}
    for name in ("size", "background", "up"):
        wanted[name] = None if wanted[name] is None else tuple(wanted[name])
    return run(**wanted)
