"""`hqgs eval RUN`: a trained scene on the photos that were held out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hqgs.base.files import write_json
from hqgs.base.stages import Stage
from hqgs.base.text import markdown_table
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Factor, ready, tell_read
from hqgs.evaluation.verdict import judged_by, verdict
from hqgs.model.formats.files import scene_file

if TYPE_CHECKING:
    from hqgs.evaluation.metrics import ViewMetrics


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Options of `hqgs eval`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of a run, or a scene file."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """The photos to measure with (those that the run was trained on)."""
    downscale: Factor = None
    """Divide the sides of the photos of --scene by F."""
    fit_cameras: bool = False
    """Also measure with each held-out camera fitted to the scene: what its pose costs is set aside."""
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
        from hqgs.evaluation.fit_cameras import Fitted, fit_cameras  # here: they load torch
        from hqgs.evaluation.held_out import held_out_renders, measured
        from hqgs.evaluation.metrics import mean_metrics
        from hqgs.model.constants import BACKGROUND
        from hqgs.model.gaussians import Gaussians
        from hqgs.scene.source import load, load_again

        with LoadingScreen() as screen:
            if options.scene is None:
                scene = load_again(options.source, on_stage=screen.stage)
            else:
                scene = load(
                    options.scene,
                    downscale=1.0 if options.downscale is None else options.downscale,
                    on_stage=screen.stage,
                )
        if not scene.test:
            raise ValueError(f"{scene.name} has no held-out photo to measure with")
        gaussians = Gaussians.load(source).in_world(scene.world)
        views = held_out_renders(scene, gaussians)
        each = measured(views)
        mean = mean_metrics(each)
        again: list[ViewMetrics] = []
        fits: list[Fitted] = []
        if options.fit_cameras:
            with LoadingScreen() as screen:
                fits = fit_cameras(
                    scene.test,
                    gaussians,
                    gaussians.sh_degree,
                    BACKGROUND,
                    lambda done: screen.stage(Stage("held-out cameras fitted", done, len(scene.test))),
                )
            fitted_scene = replace(scene, test=[fit.view for fit in fits])
            again = measured(held_out_renders(fitted_scene, gaussians))
        if options.out is not None:
            named = {name: asdict(one) for name, one in zip(views.names, each, strict=True)}
            numbers: dict[str, Any] = {"mean": asdict(mean), "views": named}
            if fits:
                moved = [{"rotation_deg": fit.rotation_deg, "moved_px": fit.pixels} for fit in fits]
                both = zip(views.names, again, moved, strict=True)
                named = {name: asdict(one) | move for name, one, move in both}
                numbers["fitted"] = {"mean": asdict(mean_metrics(again)), "views": named}
            write_json(options.out, numbers)
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{options.source}: {error}")
    tell_read(gaussians)
    title = f"{source} on the held-out photos of {scene.name}"
    print(_table(title, [*zip(views.names, each, strict=True), ("mean", mean)]))
    if fits:
        pixels = sorted(fit.pixels for fit in fits)
        rows = [*zip(views.names, again, strict=True), ("mean", mean_metrics(again))]
        print(f"\n{_table(f'{title}, each camera fitted to the scene', rows)}")
        print(f"\ncameras moved by {pixels[len(pixels) // 2]:.2f} px (median), at most {pixels[-1]:.2f} px")
    psnr, name = judged_by({**_report(options.source), "metrics": {"mean": asdict(mean)}})
    word, why = verdict(psnr)
    print(f"\nquality: {word} ({why})" + ("" if psnr == mean.psnr else f"; {psnr:.2f} dB {name}"))
    return 0


def _report(source: Path) -> dict[str, Any]:
    """The report of the run in a folder; empty for a file, or where there is none."""
    path = source / "report.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _table(title: str, rows: Sequence[tuple[str, ViewMetrics]]) -> str:
    """The metrics that the last row, the mean, has."""
    from hqgs.evaluation.metrics import METRICS  # here: it loads torch

    shown = [name for name in METRICS if getattr(rows[-1][1], name) is not None]
    cells = [[name, *(_cell(getattr(one, metric)) for metric in shown)] for name, one in rows]
    return markdown_table(title, ["photo", *shown], cells)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
