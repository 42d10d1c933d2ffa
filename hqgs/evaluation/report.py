"""The report of a training run: report.json and side-by-side pictures."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from hqgs.base.files import PICTURES, REPORT, missing_folders, remove_empty, write_json
from hqgs.base.machine import machine_facts, version_facts
from hqgs.evaluation.constants import AMPLIFICATION, CONFIDENCE, MASKED
from hqgs.evaluation.held_out import RenderedView, measured, names_of
from hqgs.evaluation.intervals import half_widths
from hqgs.evaluation.metrics import METRICS, ViewMetrics, mean_metrics
from hqgs.evaluation.records import MetricsRecord, MetricValues, Report, RunRecord
from hqgs.photos.pixels import as_floats, to_uint8, upright
from hqgs.photos.sheet import printable, sheet
from hqgs.photos.suffixes import PHOTO_SUFFIXES


def write_report(out: Path | None, record: RunRecord, views: Sequence[RenderedView]) -> Report:
    """Measure the held-out views and write the report into the folder `out`; what report.json holds.

    Files: `comparison/<view>.png` (photo | render | amplified difference) and `report.json`, which names
    them. They are made beside their places and then moved there; report.json is moved last, so where it
    exists everything else does. A run that fails before the move leaves an older report as it was. Pictures
    of other view names are not removed. `out` None: nothing is written, and no picture is named.

    Raises ValueError where a field is no JSON value, or a view's render, photo and mask do not fit, OSError
    where a file cannot be written.
    """
    _check(record)  # before work starts
    if out is None:
        return _report(record, names_of(views), measured(views), [None] * len(views))
    pictures = [f"{PICTURES}/{file}" for file in _file_names(names_of(views))]
    made = missing_folders(out)
    out.mkdir(parents=True, exist_ok=True)
    for leftover in out.glob(".report.*"):  # of a run that was killed
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()  # a page is a file
    try:
        with tempfile.TemporaryDirectory(dir=out, prefix=".report.") as name:
            stage = Path(name)
            (stage / PICTURES).mkdir()

            def draw(number: int, view: RenderedView, metrics: ViewMetrics) -> None:
                comparison_picture(view, metrics).save(stage / pictures[number], compress_level=2)

            report = _report(record, names_of(views), measured(views, draw), pictures)
            write_json(stage / REPORT, report)

            (out / PICTURES).mkdir(exist_ok=True)
            (out / REPORT).unlink(missing_ok=True)  # from here on the old report has lost its pictures
            for file in (*pictures, REPORT):
                (stage / file).replace(out / file)
    finally:
        remove_empty(made)  # after an error
    return report


def comparison_picture(view: RenderedView, metrics: ViewMetrics) -> Image.Image:
    """Photo, render and absolute difference (times 4, cut at white) side by side, a caption above each.

    Of the view as it is shown upright.
    """
    photo, render = as_floats(view.photo).clip(0, 1), view.render.clip(0, 1)
    panels = [to_uint8(panel) for panel in (photo, render, AMPLIFICATION * np.abs(render - photo))]
    amplified = f"absolute difference x{AMPLIFICATION}"
    if view.mask is not None:
        panels[2][~view.mask] = MASKED
        amplified += ", grey: masked"
    numbers = [] if metrics.psnr is None else [f"{metrics.psnr:.2f} dB"]
    numbers += [] if metrics.ssim is None else [f"SSIM {metrics.ssim:.3f}"]
    captions = [f"photo  {printable(Path(view.name).stem)}", "  ".join(["render", *numbers]), amplified]

    panels = [upright(panel, view.quarter_turns) for panel in panels]
    return sheet([list(zip(captions, panels, strict=True))])


def _report(
    record: RunRecord, names: Sequence[str], metrics: list[ViewMetrics], pictures: Sequence[str | None]
) -> Report:
    """The report of measured views."""
    mean = mean_metrics(metrics)
    measured: MetricsRecord = {
        "mean": _values(mean),
        "interval": half_widths([vars(m) for m in metrics], METRICS),
        "confidence": CONFIDENCE,
        "views": [
            {"name": name, **_values(m), "picture": picture}
            for name, m, picture in zip(names, metrics, pictures, strict=True)
        ],
        "reasons": mean.reasons,
    }
    for values, of in zip((measured, *measured["views"]), (mean, *metrics), strict=True):
        if of.psnr_shown is not None:
            values["psnr_shown"] = of.psnr_shown
    return {"metrics": measured, **record, "machine": machine_facts(), "versions": version_facts()}


def _check(record: RunRecord) -> None:
    """ValueError where a field is no JSON value."""
    for name, value in record.items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"RunRecord.{name} cannot be written as JSON: {error}") from error


def _values(metrics: ViewMetrics) -> MetricValues:
    return {metric: getattr(metrics, metric) for metric in METRICS}


def _file_names(views: list[str]) -> list[str]:
    """A PNG file name for each view: letters, digits, . _ - only, no two equal on any file system."""
    taken: set[str] = set()
    names = []
    for view in views:
        stem = view[: view.rfind(".")] if view.lower().endswith(PHOTO_SUFFIXES) else view
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._")[:80] or "view"
        name, number = stem, 2
        while name.lower() in taken:
            name, number = f"{stem}-{number}", number + 1
        taken.add(name.lower())
        names.append(f"{name}.png")
    return names
