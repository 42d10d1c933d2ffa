"""`hqgs clean SOURCE --out FILE`: remove fog and shards between the photos, where held-out photos gain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.judge import check_source, read_photos
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Factor, Number, tell_read
from hqgs.model.formats.files import FORMATS, format_of


@dataclass(frozen=True, kw_only=True)
class Clean:
    """Options of `hqgs clean`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """The folder of a run, or a scene file of this or another program."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The scene file to write; nothing is written where held-out photos do not gain."""
    photos: Annotated[str | None, tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """The photos with their cameras, in the frame of the scene file (those that the run was trained on)."""
    downscale: Factor = None
    """Divide the sides of the photos of --photos by F."""
    steps: Number = None
    """Training views to see (600)."""


OPTIONS = Clean


def run(options: Clean) -> int:
    """Clean and say what it gained; return the exit code (0 done, 1 no gain or failed, 2 bad input)."""
    try:
        source = check_source(options.source, options.photos)
        format = format_of(options.out, written=True)
        if options.out.exists() and options.out.samefile(source):
            raise ValueError(f"--out is the source {source} itself; what is removed would be lost")
        from hqgs.model.gaussians import Gaussians  # here: they load torch
        from hqgs.training.cleaning import clean
        from hqgs.training.constants import CLEANING_STEPS

        with LoadingScreen() as screen:
            scene = read_photos(options.source, options.photos, options.downscale, None, screen)
            gaussians = Gaussians.load(source)
            done = clean(
                gaussians.in_world(scene.world), scene, options.steps or CLEANING_STEPS, on_stage=screen.stage
            )
        kept = len(done.gaussians)
        words = (
            f"{sum(done.before) / len(done.before):.2f} -> {sum(done.after) / len(done.after):.2f} dB on "
            f"{len(done.after)} held-out photos ({done.gain:+.2f} ± {done.interval:.2f})"
        )
        if not done.pays:
            held = (
                "" if options.photos is None else " (photos that the scene was trained on cannot show a gain)"
            )
            return fail(1, f"{source}: cleaning does not pay, and nothing is written: {words}{held}")
        done.gaussians.in_world(gaussians.world).save(options.out)  # in the frame of the source
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{options.out}: {error}")
    tell_read(gaussians)
    if gaussians.antialiased and not FORMATS[format].antialiased:
        print(f"left out: the antialias flag: a .{format} file has no place for it")
    print(f"{options.out}: {words}; {done.removed:,} of {kept + done.removed:,} Gaussians faded and are gone")
    return 0
