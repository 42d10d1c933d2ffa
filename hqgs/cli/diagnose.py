"""`hqgs diagnose PHOTOS`: what degraded photos. It needs no cameras."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

import hqgs
from hqgs.base.files import write_json
from hqgs.cli.scenes import Photos, check_out_file, ready
from hqgs.training.config import longest_side


@dataclass(frozen=True, kw_only=True)
class Diagnose(Photos):
    """Options of `hqgs diagnose`."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the diagnosis as JSON."""


OPTIONS = Diagnose


def run(options: Diagnose) -> int:
    """Print the diagnosis; return the exit code (0 done, 1 failed, 2 bad input)."""
    if options.out is not None:
        check_out_file(options.out)
    ready(options.scene)
    from hqgs.scene.source import pictures  # here: it loads torch

    scene = pictures(
        options.scene,
        downscale=options.downscale,
        longest=longest_side("standard", options.downscale),  # as a run sees them
    )
    diagnosis = hqgs.diagnose(scene)
    if options.out is not None:
        write_json(options.out, asdict(diagnosis))
    print(diagnosis)
    for note in scene.notes:
        print(f"  {note}")
    return 0
