"""`hqgs sfm PHOTOS --out DIR`: a COLMAP folder of photos alone, or of a film."""

from __future__ import annotations

from dataclasses import dataclass

from hqgs.base.files import check_new_folder
from hqgs.base.options import Folder, Number
from hqgs.cli.errors import fail
from hqgs.cli.progress import LoadingScreen, duration
from hqgs.cli.scenes import SceneName, ready


@dataclass(frozen=True, kw_only=True)
class Sfm:
    """Options of `hqgs sfm`."""

    scene: SceneName
    """A folder with photos, or a film."""
    out: Folder
    """New or empty folder for the scene. It gets the folders images and sparse/0 of COLMAP."""
    frames: Number = None
    """Number of frames to take from a film (two per second, from 30 to 90)."""


WORK = ".sfm"  # in the new folder, while COLMAP works
OPTIONS = Sfm


def run(options: Sfm) -> int:
    """Write the scene; return the exit code (0 done, 1 failed, 2 bad input)."""
    try:
        if not (options.out / WORK).is_dir():  # of a call that was stopped
            check_new_folder(options.out)
        ready(options.scene)
        from hqgs.scene.sfm.folder import write_colmap_folder  # here: it loads torch

        with LoadingScreen() as screen:
            report = write_colmap_folder(
                options.scene, options.out, options.out / WORK, options.frames, screen.stage
            )
    except KeyboardInterrupt:
        return fail(130, "stopped; the same command continues with what COLMAP has found")
    print(report)
    print(f"{options.out}: images and sparse/0, by COLMAP in {duration(screen.colmap_seconds)}")
    print(f"next: hqgs train {options.out} --out RUN")
    return 0
