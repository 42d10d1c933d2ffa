"""One training run of the quality benchmark: what is measured of it, which renders are kept and shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.measure import Run, train
from benchmarks.protocol import degraded_view
from benchmarks.study import Cell
from hqgs.base.files import atomic_path
from hqgs.evaluation.constants import AMPLIFICATION, MASKED
from hqgs.evaluation.fit_cameras import fit_cameras
from hqgs.evaluation.held_out import held_out_renders, measured
from hqgs.evaluation.metrics import evaluate_view, mean_metrics, psnr
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.photos.sheet import printable, sheet
from hqgs.scene.scene import Scene, SfmReport
from hqgs.training.config import AUTO
from hqgs.training.trainer import Trainer

METRICS = ("psnr", "ssim", "haarpsi", "psnr_aligned")  # that the table has


def run_cell(cell: Cell, photos: Scene, pictures: list[Path], fit: bool = False) -> Run:
    """Train and measure one cell; the columns of its line. Its first held-out views become `pictures`.

    `photos` is what is trained; with `fit` the held-out views are measured a second time, each from the
    camera from which the trained scene fits its photo best.
    Raises ValueError as `Trainer` does, and TrainingError.
    """
    done = train(photos, cell.config)
    views = list(done.held_out())
    mean = asdict(mean_metrics([evaluate_view(view.render, view.photo, view.mask) for view in views]))
    for view, path in zip(views, pictures, strict=False):
        with atomic_path(path) as tmp:
            Image.fromarray(to_uint8(view.render)).save(tmp)
    formation = done.trainer.config.hqgs.formation if cell.row.method == "hqgs" else AUTO
    found = None if formation == AUTO else formation  # what the loss assumes of the photos
    run = {name: mean[name] for name in METRICS} | done.record() | {"found": found}
    return run | (_fitted(done.trainer) if fit else {}) | {"peak_mb": done.peak_rss_mb()}


def reconstruction(report: SfmReport) -> Run:
    """Poses and points from the photos against the scene's own: the columns of its line."""
    rotation, center = report.rotation_error_deg or {}, report.translation_error or {}
    return {
        "photos": report.photos,
        "registered": report.photos - len(report.not_registered),
        "rotation_median": rotation.get("median"),
        "rotation_max": rotation.get("max"),
        "centre_median": center.get("median"),
        "centre_max": center.get("max"),
        **{f"auc_{degrees}": value for degrees, value in (report.auc or {}).items()},
        "cameras_px": report.own_cameras_px,
        "points": report.points,
        "own_points": report.own_points,
        "track_length": report.track_length,
        "reprojection_px": report.reprojection_error_px,
    }


def write_sheet(
    path: Path, clean: Scene, degradation: str, seed: int, renders: Mapping[str, Path], number: int
) -> bool:
    """Write the sheet of one held-out view; False where a render was not kept.

    Above: photo, degraded photo, the render of each row. Below each of those after the first: its difference
    from the photo. No run has seen the degraded photo; it shows what happened to the training photos.
    """
    if not all(file.is_file() for file in renders.values()):
        return False
    view = clean.test[number]
    bad = degraded_view(clean, view, degradation, seed).image
    photo, degraded_photo = (to_uint8(as_floats(image)) for image in (view.image, bad))
    above = [(printable(f"photo {view.name}"), photo)]
    above.append((_caption(degradation, psnr(bad, photo, view.mask)), degraded_photo))
    for label, file in renders.items():
        with Image.open(file) as image:
            render = np.asarray(image.convert("RGB"))
        above.append((_caption(label, psnr(render, photo, view.mask)), render))
    below = [("", np.full_like(photo, 255))]
    for _, panel in above[1:]:
        error = np.minimum(AMPLIFICATION * np.abs(panel.astype(np.int64) - photo), 255).astype(np.uint8)
        if view.mask is not None:
            error[~view.mask] = MASKED
        below.append((f"difference x{AMPLIFICATION}", error))
    with atomic_path(path) as tmp:
        sheet([above, below]).save(tmp)
    return True


def _caption(label: str, value: float | None) -> str:
    return printable(label if value is None else f"{label}  {value:.2f} dB")


def _fitted(trainer: Trainer) -> dict[str, Any]:
    """The means over the held-out views with their cameras fitted to the scene, and how far these moved."""
    config, gaussians = trainer.config, trainer.shown()
    fits = fit_cameras(trainer.scene.test, gaussians, config.sh_degree, config.background)
    scene = replace(trainer.scene, test=[fit.view for fit in fits])
    mean = mean_metrics(measured(held_out_renders(scene, gaussians, config.sh_degree, config.background)))
    moved = float(np.median([fit.pixels for fit in fits]))
    return {"psnr_fitted": mean.psnr, "ssim_fitted": mean.ssim, "moved_px": moved}
