"""One training run of the quality benchmark: what is measured of it, and which renders are kept."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.measure import Run, train
from benchmarks.quality.regions import count_regions
from benchmarks.study import Cell, Store, Study
from hqgs.base.files import atomic_path
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.metrics import METRICS, evaluate_view, mean_metrics
from hqgs.model.render import render_view
from hqgs.photos.pixels import to_uint8
from hqgs.scene.scene import Scene
from hqgs.training.config import AUTO
from hqgs.training.trainer import Trainer

RENDERS = 3  # times that each held-out view is rendered


def render_path(store: Store, key: str, view: int) -> Path:
    """The render of the held-out view of that number."""
    return store.beside(key, f"{view}.png")


def run_cell(cell: Cell, photos: Scene, study: Study, renders: int = 0) -> Run:
    """Train, measure and describe one cell; so many of its held-out views are kept in the store.

    `photos` is what is trained. Raises ValueError as `Trainer` does, and TrainingError.
    """
    done = train(photos, cell.config)
    trainer = done.trainer
    views = trainer.render_test_views()
    measured = [evaluate_view(view.render, view.photo, view.mask) for view in views]
    mean = asdict(mean_metrics(measured))
    formation = trainer.config.hqgs.formation if cell.row.method == "hqgs" else AUTO
    for k, view in enumerate(views[:renders]):
        with atomic_path(render_path(study.store, study.keys[cell], k)) as tmp:
            Image.fromarray(to_uint8(view.render)).save(tmp)
    return done.record() | {
        "downscale": cell.downscale,
        "degradation": cell.degradation,
        "method": cell.row.method,
        "metrics": {name: mean[name] for name in METRICS},
        "reasons": mean["reasons"],
        "views": [
            {"name": view.name} | {name: getattr(m, name) for name in METRICS}
            for view, m in zip(views, measured, strict=True)
        ],
        "skipped_steps": trainer.guard.skipped,
        "render_ms": _render_ms(trainer),
        "regions": count_regions(trainer.shown().means.detach().numpy(), cell.scene.train),
        "formation": None if formation == AUTO else formation,  # what the loss assumes of the photos
        "left_out": [item.known() for item in trainer.method_left_out],
        "size": [views[0].photo.shape[1], views[0].photo.shape[0]],
        "notes": photos.notes,
        "sfm": None if photos.sfm is None else asdict(photos.sfm),
        "peak_rss_mb": done.peak_rss_mb(),  # of the whole cell
    }


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
