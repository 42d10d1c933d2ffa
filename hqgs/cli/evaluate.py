"""`hqgs eval RUN`: a trained scene on each photo that was held out; `hqgs judge` in short."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from hqgs.base.files import write_json
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.judge import background_of, check_source, judge_file, read_photos
from hqgs.cli.progress import LoadingScreen
from hqgs.cli.scenes import Factor
from hqgs.evaluation.judge_words import photo_table
from hqgs.evaluation.verdict import judged_by, verdict


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
    source = options.source
    try:
        file = check_source(source, options.scene, "--scene")
        from hqgs.evaluation.protocol import HELD_OUT, chosen_views  # here: it loads torch

        with LoadingScreen() as screen:
            scene = read_photos(source, options.scene, options.downscale, None, screen)
            views, background = chosen_views(scene, HELD_OUT), background_of(source)
            judged = judge_file(file, scene, views, background, screen, options.fit_cameras, look=False)
        if options.out is not None:
            write_json(options.out, judged.json())
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{options.out or source}: {error}")
    found, title = judged.json(), f"{file} on the held-out photos of {scene.name}"
    print(photo_table(title, found))
    if judged.fits:
        pixels = sorted(fit.pixels for fit in judged.fits)
        print(f"\n{photo_table(f'{title}, each camera fitted to the scene', found['fitted'])}")
        print(f"\ncameras moved by {pixels[len(pixels) // 2]:.2f} px (median), at most {pixels[-1]:.2f} px")
    psnr, name = judged_by({**_report(source), "metrics": {"mean": found["mean"]}})
    word, why = verdict(psnr)
    print(f"\nquality: {word} ({why})" + ("" if psnr == found["mean"]["psnr"] else f"; {psnr:.2f} dB {name}"))
    return 0


def _report(source: Path) -> dict[str, Any]:
    """The report of the run in a folder; empty for a file, or where there is none."""
    path = source / "report.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
