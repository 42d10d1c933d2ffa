"""`hqgs eval RUN`: a trained scene on the photos that were held out."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from hqgs.base.files import write_json
from hqgs.base.text import markdown_table
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Factor, ready
from hqgs.evaluation.verdict import verdict
from hqgs.model.formats.files import scene_file


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Options of `hqgs eval`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of a run, or a scene file."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """The photos to measure with (those that the run was trained on)."""
    downscale: Factor = None
    """Divide the sides of the photos of --scene by F."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write the numbers as JSON."""


OPTIONS = Evaluate


def run(options: Evaluate) -> int:
    """Print the metrics of each held-out view; return the exit code (0 done, 1 failed, 2 bad input)."""
    try:
        source = scene_file(options.source)
        if options.scene is None and not options.source.is_dir():
            raise ValueError(f"{options.source} is a file: --scene names the photos to measure it with")
        if options.scene is not None:
            ready(options.scene)
        from hqgs.evaluation.held_out import held_out_renders, measured  # here: they load torch
        from hqgs.evaluation.metrics import METRICS, mean_metrics
        from hqgs.model.gaussians import Gaussians
        from hqgs.scene.source import load, load_again

        with LoadingScreen() as screen:
            if options.scene is None:
                scene = load_again(options.source, told=screen.stage)
            else:
                scene = load(
                    options.scene,
                    downscale=1.0 if options.downscale is None else options.downscale,
                    told=screen.stage,
                )
        if not scene.test:
            raise ValueError(f"{scene.name} has no held-out photo to measure with")
        views = held_out_renders(scene, Gaussians.load(source))
        each = measured(views)
        mean = mean_metrics(each)
        if options.out is not None:
            named = {name: asdict(one) for name, one in zip(views.names, each, strict=True)}
            write_json(options.out, {"mean": asdict(mean), "views": named})
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{options.source}: {error}")
    shown = [name for name in METRICS if getattr(mean, name) is not None]
    rows = [
        [
            name,
            *(f"{getattr(one, metric):.4g}" if getattr(one, metric) is not None else "-" for metric in shown),
        ]
        for name, one in [*zip(views.names, each, strict=True), ("mean", mean)]
    ]
    print(markdown_table(f"{source} on the held-out photos of {scene.name}", ["photo", *shown], rows))
    word, why = verdict(mean.psnr)
    print(f"\nquality: {word} ({why})")
    return 0
