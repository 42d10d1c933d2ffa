"""`hqgs plan PHOTOS`: what a run would be, and why; nothing is trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Number, Photos, config_part, ready
from hqgs.scene.names import KEPT
from hqgs.scene.photo_files import is_run
from hqgs.training.config import AUTO, FORMATION, METHODS, run_config
from hqgs.training.settings import longest_side


@dataclass(frozen=True, kw_only=True)
class PlanOptions(Photos):
    """Options of `hqgs plan`."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of a run on these photos, whose poses are used."""
    method: Annotated[
        str, tyro.conf.arg(metavar="NAME", help_behavior_hint="", help=f"One of {', '.join(METHODS)} (auto).")
    ] = AUTO
    formation: Annotated[str, tyro.conf.arg(metavar="KIND", help_behavior_hint="")] = AUTO
    """What hqgs takes for the photos' degradation (auto: it looks)."""
    guidance: Annotated[
        Literal["formation", "paper"],
        tyro.conf.arg(help="Of hqgs: formation, or paper, its published form.", help_behavior_hint=""),
    ] = FORMATION
    leave_out: Annotated[str, tyro.conf.arg(metavar="LIST", help_behavior_hint="")] = AUTO
    """As that of train."""
    iterations: Number = None
    """Training views to see (as many as pay)."""


OPTIONS = PlanOptions


def run(options: PlanOptions) -> int:
    """Print the plan; return the exit code (0 done, 2 bad input)."""
    try:
        config = run_config(
            iterations=options.iterations,
            method=options.method,
            leave_out=options.leave_out,
            guidance=options.guidance,
            formation=options.formation,
        )
        posed = options.out is not None and (options.out / KEPT).exists()
        if options.out is not None and not posed and not is_run(options.out):
            raise ValueError(
                f"--out {options.out}: there is no run; without --out the plan is that of a new one"
            )
        ready(options.scene)
        from hqgs.scene.source import finding, load, pictures  # here: they load torch
        from hqgs.training.frame import Frame
        from hqgs.training.prepare import Prepared, plan_of_photos
        from hqgs.training.trainer import Trainer

        downscale = 1.0 if options.downscale is None else options.downscale
        longest = longest_side("standard", options.downscale)
        with LoadingScreen() as screen:
            if posed and options.out is not None:
                scene = load(
                    options.scene,
                    downscale=downscale,
                    longest=longest,
                    cache=options.out,
                    on_stage=screen.stage,
                    **finding(config_part(options.out, "scene"), options.scene),
                )
            else:
                scene = pictures(options.scene, downscale=downscale, longest=longest)
            later: list[str] = []
            if len(scene.points):
                plan = Prepared(Frame.of(scene), config, begin=Trainer).plan()
            else:
                plan, later = plan_of_photos(scene, config)
    except BAD_INPUT as error:
        return fail(2, error)
    print(f"{scene.name}: {len(scene.train)} photos, {len(scene.points):,} points")
    print(plan)
    if later:
        print(
            f"not known before the photos have poses, which hqgs train finds: {', '.join(later)}, and what "
            "photos share (exposure, shake, focus)"
        )
    return 0
