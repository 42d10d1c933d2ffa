"""`hqgs degrade SCENE --kind KIND --out DIR`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

import hqgs
from hqgs.base.files import check_new_folder
from hqgs.base.options import Folder
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Photos, ready
from hqgs.photos.formula import parse_degradation
from hqgs.scene.options import KINDS


@dataclass(frozen=True, kw_only=True)
class Degrade(Photos):
    """Options of `hqgs degrade`."""

    out: Folder
    """New or empty folder for the new scene."""
    kind: Annotated[str, tyro.conf.arg(metavar="KIND", help=f"How to degrade the training photos: {KINDS}.")]
    seed: Annotated[int, tyro.conf.arg(metavar="S")] = 0
    """Seed of all random numbers (0)."""


OPTIONS = Degrade


def run(options: Degrade) -> int:
    """Write the scene; return the exit code (0 done, 1 failed, 2 bad input)."""
    degradation = parse_degradation(options.kind)
    check_new_folder(options.out)
    ready(options.scene)
    from hqgs.scene.degrade import write_degraded_scene  # here: it loads torch

    asked: dict[str, Any] = {"downscale": options.downscale, "skip_unreadable": False, "points": False}
    with LoadingScreen() as screen:
        scene = hqgs.load(options.scene, **asked, on_stage=screen.stage)
    write_degraded_scene(scene, options.out, degradation, options.seed)
    photos = f"{len(scene.train)} training photos with {degradation}, {len(scene.test)} held out"
    print(f"{options.out}: {photos}")
    return 0
