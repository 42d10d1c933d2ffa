"""`hqgs merge RUN... --out FILE`: the runs of a scene's parts as one scene file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hqgs.base.text import markdown_table
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Factor, Number, ready
from hqgs.model.formats.files import READERS, format_of

if TYPE_CHECKING:
    from hqgs.evaluation.seams import SeamRow
    from hqgs.training.merge import Merged


@dataclass(frozen=True, kw_only=True)
class MergeParts:
    """Options of `hqgs merge`."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folders of the runs, one of each part, in any order."""
    out: Annotated[
        Path, tyro.conf.arg(metavar="FILE", help=f"The file to write; it ends in .{', .'.join(READERS)}.")
    ]
    scene: Annotated[Path | None, tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """Folder of the whole scene: its photos polish the merged scene, and those held out measure it."""
    polish: Number = None
    """With --scene: steps of all parts together on photos of all (300); 0: none."""
    whole: Annotated[Path | None, tyro.conf.arg(metavar="RUN", help_behavior_hint="")] = None
    """With --scene: measure this run of the whole scene, or scene file, in the same pixels."""
    downscale: Factor = None
    """With --scene: divide the sides of its photos by F (as the first run did)."""


OPTIONS = MergeParts


def run(options: MergeParts) -> int:
    """Write the file and print tables; return the exit code (0 done, 1 failed, 2 bad input)."""
    try:
        format_of(options.out)
        for name in ("whole", "downscale", "polish"):
            if getattr(options, name) is not None and options.scene is None:
                raise ValueError(f"--{name} is given without --scene, which names the photos")
        ready(str(options.runs[0] if options.scene is None else options.scene))
        from hqgs.training.merge import check_seams, merge  # here: they load torch

        steps = {} if options.polish is None else {"polish": options.polish}
        with LoadingScreen() as screen:
            merged = merge(options.runs, options.out, scene=options.scene, told=screen.stage, **steps)
        print(_parts_table(options, merged), end="\n\n")
        if options.scene is not None:
            print(f"polished: {merged.polished} steps on photos of all parts", end="\n\n")
        if merged.left_out:
            print(f"left out: {merged.left_out:,} Gaussians that hold NaN or Inf")
        if options.scene is not None:
            measured = check_seams(merged, options.scene, options.whole, options.downscale)
            print(_seams_table(options, measured))
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{options.out}: {error}")
    return 0


def _parts_table(options: MergeParts, merged: Merged) -> str:
    head = ["run", "part", "Gaussians", "cropped", "made brighter by"]
    rows = [
        [
            str(part.run),
            str(part.part),
            f"{part.gaussians:,}",
            f"{part.cropped:,}",
            " ".join(f"{gain:.3f}" for gain in part.gains),
        ]
        for part in merged.parts
    ]
    rows.append(["veils before cameras", "", f"{-merged.veils:,}", "", ""])
    rows.append(["the dome", "", f"{merged.dome:,}", "", ""])
    rows.append(
        [str(options.out), "", f"{len(merged.model):,}", f"{sum(p.cropped for p in merged.parts):,}", ""]
    )
    return markdown_table("Merged", head, rows)


def _seams_table(options: MergeParts, measured: list[SeamRow]) -> str:
    names = ["merged", *([] if options.whole is None else [str(options.whole), "change"])]
    rows = []
    for row in measured:
        values = [*row.psnr]
        if len(values) == 2 and None not in values:
            values.append(values[0] - values[1])  # type: ignore[operator]
        cells = ["-" if value is None else f"{value:.2f}" for value in values]
        rows.append([row.what, str(row.views), *cells, *["-"] * (len(names) - len(cells))])
    return markdown_table(
        f"PSNR (dB) on the held-out photos of {options.scene}", ["pixels", "views", *names], rows
    )
