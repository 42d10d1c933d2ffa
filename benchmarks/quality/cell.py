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
from pandas import DataFrame
from PIL import Image

from benchmarks.measure import Run, Training, train
from benchmarks.protocol import degraded, degraded_view
from benchmarks.quality.rivals import RIVALS
from benchmarks.study import Cell, Store, Study
from hqgs._rust import NEAR_PLANE
from hqgs.base.files import atomic_path
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.fit_cameras import fit_cameras
from hqgs.evaluation.held_out import held_out_renders, measured
from hqgs.evaluation.metrics import METRICS, evaluate_view, mean_metrics, psnr
from hqgs.evaluation.report import AMPLIFICATION, MASKED
from hqgs.model.render import render_view
from hqgs.photos.edges import edge_magnitude
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.photos.sheet import printable, sheet
from hqgs.scene.geometry import project
from hqgs.scene.scene import Scene, View
from hqgs.training.config import AUTO
from hqgs.training.methods.base import photo_tensors
from hqgs.training.plan import left_out_of
from hqgs.training.trainer import Trainer

EDGE_SHARE = 0.2  # of the pixels of a photo, those with the largest gradient, are its edges
MAX_PHOTOS = 8  # of a scene, whose edge maps are compared
RENDERS = 3  # times that each held-out view is rendered


def run_cell(cell: Cell, photos: Scene, study: Study, renders: int = 0, fit: bool = False) -> Run:
    """Train, measure and describe one cell; so many of its held-out views are kept in the store.

    `photos` is what is trained; with `fit` the held-out views are measured a second time, each from the
    camera from which the trained scene fits its photo best.
    Raises ValueError as `Trainer` does, and TrainingError.
    """
    rival = cell.more.get("rival")
    done = RIVALS[rival](photos, cell.config) if rival else train(photos, cell.config)
    views = list(done.held_out())
    each = [evaluate_view(view.render, view.photo, view.mask) for view in views]
    mean = asdict(mean_metrics(each))
    for k, view in enumerate(views[:renders]):
        with atomic_path(study.beside(cell, f"{k}.png")) as tmp:
            Image.fromarray(to_uint8(view.render)).save(tmp)
    return done.record() | {
        "downscale": cell.downscale,
        "degradation": cell.degradation,
        "method": rival or cell.row.method,
        "metrics": {name: mean[name] for name in METRICS},
        "reasons": mean["reasons"],
        "views": [
            {"name": view.name} | {name: getattr(m, name) for name in METRICS}
            for view, m in zip(views, each, strict=True)
        ],
        **(_facts(done.trainer, cell) if isinstance(done, Training) else {}),
        **(_fitted(done.trainer) if fit and isinstance(done, Training) else {}),
        "size": [views[0].photo.shape[1], views[0].photo.shape[0]],
        "notes": photos.notes,
        "sfm": None if photos.sfm is None else asdict(photos.sfm),
        "peak_rss_mb": done.peak_rss_mb(),  # of the whole cell
    }


def write_sheet(
    path: Path, store: Store, clean: Scene, runs: Mapping[str, dict[str, Any]], number: int
) -> bool:
    """Write the sheet of one held-out view; False where a render was not kept.

    Above: photo, degraded photo, the render of each run. Below each of those after the first: its difference
    from the photo. No run has seen the degraded photo; it shows what happened to the training photos.
    """
    files = {label: store.beside(run["key"], f"{number}.png") for label, run in runs.items()}
    if not all(file.is_file() for file in files.values()):
        return False
    first = next(iter(runs.values()))
    view = clean.test[number]
    bad = degraded_view(clean, view, first["degradation"], first["seed"]).image
    photo, degraded_photo = (to_uint8(as_floats(image)) for image in (view.image, bad))
    above = [(printable(f"photo {view.name}"), photo)]
    above.append((_caption(first["degradation"], psnr(bad, photo, view.mask)), degraded_photo))
    for label, run in runs.items():
        with Image.open(files[label]) as image:
            above.append((_caption(label, run["views"][number]["psnr"]), np.asarray(image.convert("RGB"))))
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


def _facts(trainer: Trainer, cell: Cell) -> dict[str, Any]:
    """What there is to know of Gaussians and of their method."""
    formation = trainer.config.hqgs.formation if cell.row.method == "hqgs" else AUTO
    return {
        "skipped_steps": trainer.guard.skipped,
        "render_ms": _render_ms(trainer),
        "regions": count_regions(trainer.shown().means.detach().numpy(), cell.scene.train),
        "formation": None if formation == AUTO else formation,  # what the loss assumes of the photos
        "left_out": [item.known() for item in left_out_of(trainer.plan.rows)],
    }


def _fitted(trainer: Trainer) -> dict[str, Any]:
    """The means over the held-out views with their cameras fitted to the scene, and how far these moved."""
    config, gaussians = trainer.config, trainer.shown()
    fits = fit_cameras(trainer.scene.test, gaussians, config.sh_degree, config.background)
    scene = replace(trainer.scene, test=[fit.view for fit in fits])
    mean = mean_metrics(measured(held_out_renders(scene, gaussians, config.sh_degree, config.background)))
    moved = float(np.median([fit.pixels for fit in fits]))
    return {"fitted": {name: asdict(mean)[name] for name in METRICS} | {"moved_px": moved}}


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


def count_regions(means: NDArray[np.float32], views: Sequence[View]) -> dict[str, Any]:
    """Gaussians and pixels on edges and in flat parts, sums over the views.

    A Gaussian counts in each view into which its mean [N, 3] projects, seen or hidden there, however
    transparent. Edges are the `EDGE_SHARE` of a clean photo's pixels with the largest Sobel gradient, mean
    over channels; ties at the limit are flat. `density` is Gaussians per 1,000 pixels.
    """
    regions: dict[str, Any] = {name: {"gaussians": 0, "pixels": 0} for name in ("edge", "flat")}
    for view in views:
        camera = view.camera
        pixels, depths = project(camera, means.astype(np.float64))
        pixels = np.floor(pixels[depths > NEAR_PLANE])  # column, row: pixel j spans j to j + 1
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        columns, rows = pixels[inside].astype(np.int64).T
        hits = np.zeros((camera.height, camera.width), np.int64)
        np.add.at(hits, (rows, columns), 1)
        counted = np.ones(hits.shape, bool) if view.mask is None else view.mask
        edges = _edge_map(view).mean(axis=2)
        limit = np.quantile(edges[counted], 1 - EDGE_SHARE) if counted.any() else 0.0
        for name, where in (("edge", counted & (edges > limit)), ("flat", counted & (edges <= limit))):
            regions[name]["gaussians"] += int(hits[where].sum())
            regions[name]["pixels"] += int(where.sum())
    for region in regions.values():
        region["density"] = 1_000 * region["gaussians"] / region["pixels"] if region["pixels"] else None
    return regions


def edge_robustness(scene: Scene, degradations: Sequence[str], seed: int) -> dict[str, Any]:
    """How alike photos and their edge maps are before and after each degradation.

    Up to `MAX_PHOTOS` training photos, spread over the scene: PSNR of the degraded photo against the clean
    one, and of the edge map of the one against that of the other; means over the photos that the degradation
    changes. The variances are over the degradations (sample variance, dB^2; None for fewer than two).
    """
    spread = np.unique(np.linspace(0, len(scene.train) - 1, MAX_PHOTOS).round().astype(np.int64))
    values: dict[str, dict[str, float]] = {}
    for degradation in degradations:
        bad = degraded(scene, degradation, seed).train  # what happens to one may hang on the others
        pairs = []
        for clean, view in ((scene.train[k], bad[k]) for k in spread):
            photo = psnr(view.image, clean.image, clean.mask)
            edges = psnr(_edge_map(view), _edge_map(clean), clean.mask)
            if photo is not None and edges is not None:
                pairs.append((photo, edges))
        if pairs:  # "none" leaves them identical
            photo, edges = np.mean(pairs, axis=0).tolist()
            values[degradation] = {"photo_psnr": photo, "edge_psnr": edges}
    found = DataFrame(values.values(), columns=["photo_psnr", "edge_psnr"]).var()
    variances = {
        str(name).replace("psnr", "variance"): None if v != v else float(v) for name, v in found.items()
    }
    return {"scene": scene.name, "photos": len(spread), "degradations": values, **variances}


def _edge_map(view: View) -> NDArray[np.float32]:
    photo, mask = photo_tensors(view)
    with one_torch_thread(), torch.no_grad():
        return edge_magnitude(photo, mask).float().numpy()
