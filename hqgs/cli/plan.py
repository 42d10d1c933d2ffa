"""`hqgs plan PHOTOS`: what a run would be, and why; nothing is trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from hqgs.base.options import Number, Unsaid, given
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Photos, ready
from hqgs.evaluation.run_folder import RunFolder
from hqgs.scene.constants import TEST_EVERY
from hqgs.scene.names import KEPT
from hqgs.scene.photo_files import is_run
from hqgs.training.config import STANDARD, PresetOption, TrainOptions, decided, longest_side


@dataclass(frozen=True, kw_only=True)
class PlanOptions(TrainOptions, PresetOption, Photos):
    """Options of `hqgs plan`."""

    test_every: Number = None
    """Hold out every N-th photo, as in hqgs train."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), Unsaid] = None
    """Folder of a run on these photos; its poses are used."""


OPTIONS = PlanOptions


def run(options: PlanOptions) -> int:
    """Print the plan; return the exit code (0 done, 2 bad input)."""
    config = decided({"preset": given(options.preset, STANDARD)} | options.said())
    posed = options.out is not None and (options.out / KEPT).exists()
    if options.out is not None and not posed and not is_run(options.out):
        raise ValueError(f"--out {options.out}: there is no run; leave --out away to plan a new run")
    ready(options.scene)
    from hqgs.scene.source import finding, load, pictures  # here: they load torch
    from hqgs.training.frame import Frame
    from hqgs.training.prepare import Prepared, plan_of_photos
    from hqgs.training.trainer import Trainer

    told = {} if options.out is None else RunFolder(options.out).loaded
    asked: dict[str, Any] = {
        "downscale": options.downscale,
        "longest": longest_side(options.preset, options.downscale),
        "test_every": given(options.test_every, given(told.get("test_every"), TEST_EVERY)),
    }
    with LoadingScreen() as screen:
        if posed:
            asked |= {"cache": options.out, "on_stage": screen.stage}
            scene = load(options.scene, **asked, **finding(told, options.scene))
        else:
            scene = pictures(options.scene, **asked)
        if not scene.train:
            raise ValueError(f"{scene.name}: no photo is left to train on")
        later: list[str] = []
        if len(scene.points):
            plan = Prepared(Frame.of(scene), config, begin=Trainer).plan()
        else:
            plan, later = plan_of_photos(scene, config)
    photos = f"{scene.of or len(scene.train)} photos to train on"
    looked = f" ({len(scene.train)} of them measured)" if scene.of not in (None, len(scene.train)) else ""
    print(f"{scene.name}: {photos}{looked}, {len(scene.points):,} points")
    for note in scene.notes:
        print(f"  {note}")
    print(plan)
    if later:
        print(
            f"not known before hqgs train has found the poses: {', '.join(later)}, and what needs points "
            "that photos share (exposure, shake, focus)"
        )
    return 0
