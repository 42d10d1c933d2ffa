"""`hqgs clean SOURCE --out FILE`: remove fog and shards between the photos, where held-out photos gain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import tyro

from hqgs.base.options import Number, given
from hqgs.cli.errors import fail
from hqgs.cli.judge import check_source
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import MeasuredOptions, check_out_file, measured_scene, tell_read
from hqgs.photos.formula import NONE

if TYPE_CHECKING:
    from hqgs.model.gaussians import Gaussians
    from hqgs.training.cleaning import Cleaned


@dataclass(frozen=True, kw_only=True)
class Clean(MeasuredOptions):
    """Options of `hqgs clean`."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The scene file to write; it is written only if renders of held-out photos improve."""
    steps: Number = None
    """Number of training views to render (600)."""


OPTIONS = Clean


def run(options: Clean) -> int:
    """Clean and say what it gained; return the exit code (0 done, 1 no gain or failed, 2 bad input)."""
    from hqgs.model.formats.files import format_of, scene_file  # here: --help waits for no array

    format = format_of(options.out, written=True)
    check_out_file(options.out, scene_file(options.source))
    source = check_source(options.source, options.photos)
    from hqgs.evaluation.run_folder import RunFolder  # here: they load torch
    from hqgs.model.gaussians import Gaussians
    from hqgs.training.cleaning import CLEANING_STEPS, check_steps, clean, held_out_psnrs

    steps = given(options.steps, CLEANING_STEPS)
    check_steps(steps)
    run = RunFolder.open(options.source)
    plan = [] if run.report is None else run.report["plan"]
    if undone := [row["value"] for row in plan if row["what"] == "formation" and row["value"] != NONE]:
        raise ValueError(
            f"{options.source} is a run that corrects its photos ({undone[-1]}): cleaning would fit the "
            "scene to the photos as they are"
        )
    background = run.background
    with LoadingScreen() as screen:
        scene = measured_scene(run, options, screen)
        gaussians = Gaussians.load(source)
        done = clean(gaussians.in_world(scene.world), scene, steps, background, screen.stage)
    cleaned = done.gaussians.in_world(gaussians.world)  # in the frame of the source
    with TemporaryDirectory() as folder:  # what counts is the file: its format may hold less
        cleaned.save(Path(folder, options.out.name))
        back = Gaussians.load(Path(folder, options.out.name))
    written = replace(done, after=held_out_psnrs(back.in_world(scene.world), scene, background))
    words = gained(written)
    if not written.pays:
        lossy = f" as a .{format} file, which is less exact" if done.pays else ""
        if options.photos is not None:
            words += " (photos that the scene was trained on cannot show an improvement)"
        return fail(1, f"{source}: held-out photos do not improve{lossy}; nothing was written: {words}")
    cleaned.save(options.out)
    tell_read(gaussians)
    for what in left_out(gaussians, cleaned, back, format):
        print(f"left out: {what}")
    print(f"{options.out}: {words}; {done.removed:,} of {len(gaussians):,} Gaussians were removed")
    return 0


def gained(done: Cleaned) -> str:
    """What held-out photos say of it."""
    if not done.pairs:
        return "no held-out photo could be measured"
    before, after = (sum(pair[k] for pair in done.pairs) / len(done.pairs) for k in (0, 1))
    photos = f"{len(done.pairs)} held-out photos ({done.gain:+.2f} ± {done.interval:.2f})"
    return f"{before:.2f} -> {after:.2f} dB on {photos}"


def left_out(source: Gaussians, cleaned: Gaussians, back: Gaussians, format: str) -> list[str]:
    """What the file does not hold of the source, but for what faded; `back` is the file as it is read."""
    from hqgs.model.formats.files import FORMATS

    found = list[str]()
    if source.antialiased and not FORMATS[format].antialiased:
        found.append(f"the antialias flag: a .{format} file cannot store it")
    if back.sh_degree < source.sh_degree:
        found.append(f"harmonics above degree {back.sh_degree}: a .{format} file cannot store them")
    if lost := len(cleaned) - len(back):
        found.append(f"{lost:,} Gaussians that a .{format} file cannot store")
    if source.errors is not None:
        found.append("the errors of the Gaussians (trust): measured before cleaning, no longer valid")
    return found
