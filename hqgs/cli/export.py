"""`hqgs export SOURCE --out FILE`: write a scene with the bands and the precision that matter."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hqgs.base.text import markdown_table
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.export.options import ExportOptions
from hqgs.model.formats.files import READERS, format_of, scene_file

if TYPE_CHECKING:
    from hqgs.export.export import Export
    from hqgs.model.gaussians import Gaussians
    from hqgs.scene.scene import Scene

DEFAULTS = ExportOptions("ply")


def add_parser(commands: argparse._SubParsersAction[Any], run: Callable[[argparse.Namespace], int]) -> None:
    """Add `export` to the subcommands of a parser."""
    parser = commands.add_parser("export", help="write a scene file with what the scene needs alone")
    parser.set_defaults(run=run)
    add = parser.add_argument
    add("source", type=Path, metavar="SOURCE", help="a scene file, or the folder of a run")
    add("--out", type=Path, required=True, metavar="FILE", help="the file to write")
    add("--format", choices=READERS, help="(what the suffix of FILE says)")
    add("--sh-degree", type=int, default=DEFAULTS.sh_degree, metavar="D", help="at most (%(default)s)")
    add(
        "--sh-bits",
        type=int,
        nargs=2,
        default=DEFAULTS.sh_bits,
        metavar="B",
        help="spz: of the harmonics of degree 1, and of degrees 2 and 3 (8 8)",
    )
    add(
        "--band-tolerance",
        type=float,
        default=DEFAULTS.band_tolerance,
        metavar="T",
        help="harmonics that change a colour by no more are left out; white is 1 (%(default)s)",
    )
    add("--scene", metavar="SCENE", help="measure the file on the held-out views of this scene")
    add("--downscale", type=float, default=1.0, metavar="F", help="of those views (%(default)s)")


def run_export(args: argparse.Namespace, load_scene: Callable[[], Scene | None]) -> int:
    """Export what `args` say and print tables; return the exit code (0 done, 1 failed, 2 bad input)."""
    try:
        options = ExportOptions(
            format=format_of(args.out, args.format),
            sh_degree=args.sh_degree,
            band_tolerance=args.band_tolerance,
            sh_bits=tuple(args.sh_bits),
        )
        source = scene_file(args.source)
        if args.out.exists() and args.out.samefile(source):
            raise ValueError(f"--out is the source {source} itself; what is left out would be lost")
        from hqgs.evaluation.held_out import held_out_psnr, held_out_renders  # here: they load torch
        from hqgs.export.export import export
        from hqgs.model.gaussians import Gaussians

        gaussians = Gaussians.load(source)
        scene = load_scene()
        before = None if scene is None else held_out_psnr(scene, held_out_renders(scene, gaussians))
        written = export(gaussians, args.out, options)
        after = None
        if scene is not None:
            back = Gaussians.load(args.out, options.format)
            after = held_out_psnr(scene, held_out_renders(scene, back))
    except BAD_INPUT as error:
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    print(_table(source, gaussians, before, written, after), end="\n\n")
    for entry in written.left_out:
        evidence = "" if entry.evidence is None else f" ({entry.evidence})"
        saved = "" if entry.bytes is None else f": {entry.bytes:,} bytes"
        print(f"left out: {entry.what}: {entry.why}{evidence}{saved}")
    for name, count in written.clipped.items():
        print(f"outside the range of spz, set to its end: {count:,} values of {name}")
    return 0


def _table(
    source: Path, gaussians: Gaussians, before: float | None, written: Export, after: float | None
) -> str:
    size = source.stat().st_size
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
