"""`hqgs export SOURCE --out FILE`: write a scene with the bands and the precision that matter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hqgs.base.options import Factor, Flag, Number, Unsaid, values
from hqgs.base.text import markdown_table
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import MeasuredOptions, check_out_file, measured_scene, ready, tell_read
from hqgs.model.formats.files import FORMATS, WRITTEN, bytes_of, format_of, scene_file
from hqgs.show.export_options import ExportOptions

if TYPE_CHECKING:
    from hqgs.evaluation.run_folder import RunFolder
    from hqgs.model.gaussians import Gaussians
    from hqgs.scene.scene import Scene
    from hqgs.show.export import Export


@dataclass(frozen=True, kw_only=True)
class ExportScene:
    """Options of `hqgs export`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A scene file, or the folder of a run."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The file to write."""
    format: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="FORMAT", help_behavior_hint="", help=f"{', '.join(WRITTEN)} (by the suffix of FILE)."
        ),
    ] = None
    sh_degree: Number = None
    """Highest degree of the spherical harmonics (3); lower if the scene does not need it."""
    sh_bits: Annotated[tuple[int, int] | None, values("B B", "two whole numbers", int, int), Unsaid] = None
    """SPZ: bits of the harmonics of degree 1, and of degrees 2 and 3 (8 8)."""
    spz_version: Number = None
    """SPZ: version 3, which most programs read, or 4, which is smaller and which newer programs need (3)."""
    band_tolerance: Factor = None
    """Leave out harmonics that change colours by at most this; white is 1 (0.004)."""
    trust: Flag = False
    """Also write the error of each Gaussian, measured by the photos of the run: PLY, glTF."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """Measure the file on the held-out photos of this scene."""
    downscale: Factor = None
    """Divide width and height of those photos by F."""


OPTIONS = ExportScene


def run(args: ExportScene) -> int:
    """Export what `args` say and print tables; return the exit code (0 done, 1 failed, 2 bad input)."""
    of_files = ("sh_degree", "sh_bits", "spz_version", "band_tolerance")  # how a file is written
    said = {name: value for name in of_files if (value := getattr(args, name)) is not None}
    options = ExportOptions(format_of(args.out, args.format, written=True), **said)
    _check_together(args, options.format)
    source = scene_file(args.source)
    check_out_file(args.out, source)
    if args.trust and not FORMATS[options.format].errors:
        places = " and ".join(f".{name}" for name, format in FORMATS.items() if format.errors)
        raise ValueError(f"--trust: a .{options.format} file cannot store it; {places} files can")
    from hqgs.evaluation.held_out import held_out_psnr, held_out_renders, looks_beside  # here: torch
    from hqgs.evaluation.run_folder import RunFolder
    from hqgs.model.gaussians import Gaussians
    from hqgs.show.export import export, measure

    gaussians, run = Gaussians.load(source), RunFolder.open(args.source)
    known = gaussians.along(run.cameras)
    scene = None if args.scene is None else _held_out_photos(run, args)
    looks = {} if scene is None else looks_beside(source, scene.train)  # that the run measures with
    if args.trust:
        from hqgs.show.trust import trust_of

        gaussians.errors = trust_of(gaussians, known).errors.clamp(max=1)

    def held_out(shown: Gaussians) -> float | None:
        if scene is None:
            return None
        renders = held_out_renders(scene, shown, background=run.background, looks=looks)
        return held_out_psnr(scene, renders)

    before = held_out(gaussians)
    written = export(gaussians, args.out, options)
    back = Gaussians.load(args.out, options.format)
    after = held_out(back)
    try:
        changed = f"measured: {measure(gaussians, back, known)}"
    except ValueError as error:
        changed = f"not measured: {error}"
    print(_table(source, gaussians, before, written, after), end="\n\n")
    tell_read(gaussians)
    print(changed)
    for entry in written.left_out:
        evidence = "" if entry.evidence is None else f" ({entry.evidence})"
        print(f"left out: {entry.what}: {entry.why}{evidence}")
    for name, count in written.clipped.items():
        print(f"outside the range of spz, set to its end: {count:,} values of {name}")
    return 0


def _check_together(args: ExportScene, format: str) -> None:
    """ValueError for options that another one leaves without effect."""
    if args.downscale is not None and args.scene is None:
        raise ValueError("--downscale is for the photos of --scene: give --scene too")
    for name in ("sh_bits", "spz_version"):
        if format != "spz" and getattr(args, name) is not None:
            asked = f"--out {args.out}" if args.format is None else "--format"
            raise ValueError(f"--{name.replace('_', '-')} is for spz, and {asked} says {format}")


def _held_out_photos(run: RunFolder, args: ExportScene) -> Scene:
    """The photos of `--scene` in the frame of the scene file, those held out that its run held out."""
    photos = str(args.scene)
    ready(photos)
    with LoadingScreen() as screen:
        asked = MeasuredOptions(source=args.source, photos=photos, downscale=args.downscale)
        return measured_scene(run, asked, screen)


def _table(
    source: Path, gaussians: Gaussians, before: float | None, written: Export, after: float | None
) -> str:
    size = bytes_of(source)
    head = ["file", "Gaussians", "SH degree", "bytes", "of the source"]
    rows = [
        [str(source), f"{len(gaussians):,}", str(gaussians.sh_degree), f"{size:,}", ""],
        [
            str(written.path),
            f"{written.gaussians:,}",
            str(written.sh_degree),
            f"{written.bytes:,}",
            f"{100 * written.bytes / size:.1f} %",
        ],
    ]
    if before is not None and after is not None:
        head += ["held-out PSNR (dB)", "change"]
        rows[0] += [f"{before:.3f}", ""]
        rows[1] += [f"{after:.3f}", f"{after - before:+.3f}"]
    return markdown_table("Exported", head, rows)
