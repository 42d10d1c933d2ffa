"""One training run of the quality benchmark: what is measured of it, which renders are kept and shown."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.measure import Run, train
from benchmarks.protocol import degraded_view
from benchmarks.study import Cell
from hqgs.base.evenly import middles
from hqgs.base.files import atomic_path
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.constants import AMPLIFICATION, MASKED
from hqgs.evaluation.fit_cameras import fit_cameras
from hqgs.evaluation.held_out import held_out_renders, measured
from hqgs.evaluation.metrics import evaluate_view, mean_metrics, psnr
from hqgs.model.render import render_view
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.photos.sheet import printable, sheet
from hqgs.scene.geometry import shrunk_camera
from hqgs.scene.scene import Scene, SfmReport
from hqgs.training.config import AUTO
from hqgs.training.trainer import Trainer

CONTACTS, CONTACT_SIDE, CONTACT_COLORS = 4, 232, 128  # of a small sheet: views, their longest side in px
RENDERS = 3  # times that each held-out view is rendered
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
    facts = _facts(done.trainer, cell) | (_fitted(done.trainer) if fit else {})
    run = {name: mean[name] for name in METRICS} | {"fall": fall(done.trainer.history)}
    return run | done.record() | facts | {"peak_mb": done.peak_rss_mb()}


def fall(history: Sequence[Mapping[str, Any]]) -> float | None:
    """dB from the best moment of a run to its last, over moments that measured as many views as the end."""
    last = history[-1]
    values = [entry["psnr"] for entry in history if entry.get("views") == last.get("views")]
    return None if None in values else max(values) - last["psnr"]


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


def write_contacts(path: Path, clean: Scene, kept: Mapping[int, Mapping[str, Path]]) -> None:
    """Write a small sheet: a line for some of the held-out views, its photo and the render of each row.

    `kept`: the renders by the view's number. Views of another size than the first are not shown.
    """
    cameras = {number: shrunk_camera(clean.test[number].camera, CONTACT_SIDE) for number in kept}
    sizes = {number: (camera.width, camera.height) for number, camera in cameras.items()}
    size = next(iter(sizes.values()))
    alike = [number for number in kept if sizes[number] == size]
    lines = list[list[tuple[str, NDArray[np.uint8]]]]()
    for k in middles(len(alike), CONTACTS):
        view, files = clean.test[alike[k]], kept[alike[k]]
        photo = Image.fromarray(to_uint8(as_floats(view.image)))
        line = [(printable(view.name), np.asarray(photo.resize(size)))]
        for label, file in files.items():
            with Image.open(file) as image:
                line.append((printable(label), np.asarray(image.convert("RGB").resize(size))))
        lines.append(line)
    with atomic_path(path) as tmp:
        sheet(lines).quantize(CONTACT_COLORS, dither=Image.Dither.NONE).save(tmp, optimize=True)


def _caption(label: str, value: float | None) -> str:
    return printable(label if value is None else f"{label}  {value:.2f} dB")


def _facts(trainer: Trainer, cell: Cell) -> dict[str, Any]:
    """What there is to know of Gaussians and of their method."""
    formation = trainer.config.hqgs.formation if cell.row.method == "hqgs" else AUTO
    found = None if formation == AUTO else formation  # what the loss assumes of the photos
    return {"render_ms": _render_ms(trainer), "found": found}


def _fitted(trainer: Trainer) -> dict[str, Any]:
    """The means over the held-out views with their cameras fitted to the scene, and how far these moved."""
    config, gaussians = trainer.config, trainer.shown()
    fits = fit_cameras(trainer.scene.test, gaussians, config.sh_degree, config.background)
    scene = replace(trainer.scene, test=[fit.view for fit in fits])
    mean = mean_metrics(measured(held_out_renders(scene, gaussians, config.sh_degree, config.background)))
    moved = float(np.median([fit.pixels for fit in fits]))
    return {"psnr_fitted": mean.psnr, "ssim_fitted": mean.ssim, "moved_px": moved}


def _render_ms(trainer: Trainer) -> float:
    """Median milliseconds in which the trained scene, as it would be exported, gives one held-out view."""
    config, gaussians = trainer.config, trainer.shown()
    milliseconds = []
    with one_torch_thread(), torch.no_grad():
        for view in RENDERS * trainer.scene.test:
            started = time.perf_counter()
            render_view(gaussians, view.camera, config.sh_degree, config.background)
            milliseconds.append(1_000 * (time.perf_counter() - started))
    return float(np.median(milliseconds))
