"""One training run of a quality benchmark, and the folder that keeps the finished ones."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import hqgs
from benchmarks.output import kept
from benchmarks.quality.protocols import Cell
from benchmarks.quality.regions import count_regions
from hqgs.base.files import atomic_path, write_json
from hqgs.base.machine import peak_rss_mb, reset_peak_rss
from hqgs.base.threads import one_torch_thread
from hqgs.evaluation.held_out import RenderedView
from hqgs.evaluation.metrics import METRICS, evaluate_view, mean_metrics
from hqgs.model.render import render_view
from hqgs.photos.pixels import to_uint8
from hqgs.scene.scene import Scene
from hqgs.training.config import AUTO, METHODS, PAPER
from hqgs.training.trainer import Trainer

FORMAT = 1  # raised when a run records something else
KEY = r"[A-Za-z0-9_][A-Za-z0-9._-]*"  # what a run's name looks like: no path
FIRST_STEPS = slice(3, 13)  # the steps whose median is a first step's time: warm, and before any growth
RENDERS = 3  # times that each held-out view is rendered


@dataclass(frozen=True)
class RunStore:
    """`runs/KEY.json` for each finished cell and `renders/KEY/N.png` for the picture sheets."""

    root: Path
    validate: bool
    sfm: bool = False  # poses and points are those of the degraded photos

    def key(self, cell: Cell, fingerprint: dict[str, str]) -> str:
        """Readable, and a digest of all that the result depends on: configuration, photos, version.

        `fingerprint`: `scene_fingerprint` of the scene before the degradation, which follows from the cell.
        Options of other methods do not count, nor does the name of the row: a run serves all protocols.
        """
        config = {k: v for k, v in asdict(cell.config).items() if k not in METHODS or k == cell.row.method}
        if not config["leave_out"]:
            del config["leave_out"]  # runs from before there was such a choice are the same
        if cell.row.method == "hqgs" and cell.row.hqgs.guidance == PAPER:
            del config["hqgs"]["first_points"]  # so are the paper's, which has no use for it
        facts = {
            "format": FORMAT,
            "version": hqgs.__version__,
            "config": config,
            "degradation": cell.degradation,
            "scene": fingerprint,
        }
        if self.sfm:
            facts["sfm"] = True
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]
        parts = [cell.scene, f"x{cell.downscale:g}", cell.degradation, cell.row.method, f"s{cell.seed}"]
        parts += [str(cell.iterations), *(["validation"] if self.validate else [])]
        parts += [*(["sfm"] if self.sfm else []), digest]
        return re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts))

    def read(self, key: str) -> dict[str, Any] | None:
        """The finished run, None where there is none; ValueError for a damaged file."""
        path = self._path(key)
        run = kept(path)
        if run is not None and run.get("key") != key:
            raise ValueError(f"{path} is not the run of that name; remove it, and the run is repeated")
        return run

    def take(self, path: Path) -> None:
        """Keep the runs of a result file of this benchmark that are not there yet, without their renders.

        ValueError where it is no such file.
        """
        try:
            runs = json.loads(path.read_text(encoding="utf-8"))["results"]["runs"]
            keys = [run["key"] for run in runs]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"known: {path} holds no runs of this benchmark: {error!r}") from error
        for key, run in zip(keys, runs, strict=True):
            if not re.fullmatch(KEY, key):
                raise ValueError(f"known: {path} has a run of the name {key!r}")
            if not self._path(key).exists():
                write_json(self._path(key), run)

    def write(self, run: dict[str, Any], renders: Sequence[RenderedView]) -> None:
        """Keep a run and some of its renders; the JSON comes last, so that it vouches for them."""
        for k, view in enumerate(renders):
            with atomic_path(self.render_path(run["key"], k)) as tmp:
                Image.fromarray(to_uint8(view.render)).save(tmp)
        write_json(self._path(run["key"]), run)

    def render_path(self, key: str, view: int) -> Path:
        """The render of the held-out view of that number."""
        return self.root / "renders" / key / f"{view}.png"

    def _path(self, key: str) -> Path:
        return self.root / "runs" / f"{key}.json"


def run_cell(
    cell: Cell, key: str, clean: Scene, photos: Scene, facts: dict[str, Any]
) -> tuple[dict[str, Any], list[RenderedView]]:
    """Train, measure and describe one cell; also returns its held-out views.

    `clean` is the scene before the degradation, `photos` what is trained; `facts` are added as they are.
    Raises ValueError as `Trainer` does, and TrainingError.
    """
    resets = reset_peak_rss()
    started = time.perf_counter()
    trainer = Trainer(photos, cell.config)
    setup = time.perf_counter() - started
    first_points = len(trainer.gaussians)
    steps, cpu = train(trainer, cell.iterations)
    trainer.evaluate()
    views = trainer.render_test_views()
    measured = [evaluate_view(view.render, view.photo, view.mask) for view in views]
    mean = asdict(mean_metrics(measured))
    with torch.no_grad():
        means = trainer.method.modulate(trainer.gaussians).means.detach().numpy()
    formation = trainer.config.hqgs.formation if cell.row.method == "hqgs" else AUTO
    run = {
        "key": key,
        "scene": cell.scene,
        "downscale": cell.downscale,
        "degradation": cell.degradation,
        "method": cell.row.method,
        "seed": cell.seed,
        "iterations": cell.iterations,
        "metrics": {name: mean[name] for name in METRICS},
        "reasons": mean["reasons"],
        "views": [
            {"name": view.name} | {name: getattr(m, name) for name in METRICS}
            for view, m in zip(views, measured, strict=True)
        ],
        "seconds": trainer.seconds,  # in training steps
        "cpu_seconds": cpu,  # of all threads in them; tells a busy machine from a slow method
        "setup_seconds": setup,  # diagnosis, operators, tokens
        "first_step_seconds": first_step(steps),
        "history": trainer.history,
        "initial_points": first_points,
        "gaussians": len(trainer.gaussians),
        "skipped_steps": trainer.guard.skipped,
        "render_ms": _render_ms(trainer),
        "regions": count_regions(means, clean.train),
        "formation": None if formation == AUTO else formation,  # what the loss assumes of the photos
        "left_out": [{"what": what, "why": why} for what, why in trainer.method.left_out()],
        "size": [views[0].photo.shape[1], views[0].photo.shape[0]],
        "notes": photos.notes,
        "sfm": None if photos.sfm is None else asdict(photos.sfm),
        "config": asdict(trainer.config),
        "threads": hqgs.get_num_threads(),
        "peak_rss_mb": peak_rss_mb() if resets else None,  # of this run, with what the process holds
        "wall_seconds": time.perf_counter() - started,
        **facts,
    }
    return run, views


def train(trainer: Trainer, iterations: int) -> tuple[list[float], float]:
    """Train with the evaluations that the configuration asks for: seconds of each step, and of the CPU."""
    seconds, cpu = [], 0.0
    while trainer.iteration < iterations:
        before, clock = trainer.seconds, time.process_time()
        trainer.step()
        seconds.append(trainer.seconds - before)
        cpu += time.process_time() - clock
        if trainer.iteration % trainer.config.eval_every == 0:
            trainer.evaluate()
    return seconds, cpu


def first_step(seconds: Sequence[float]) -> float:
    """Seconds of a step before any growth."""
    return float(np.median(seconds[FIRST_STEPS] or seconds))


def _render_ms(trainer: Trainer) -> float:
    """Median milliseconds in which the trained scene, as it would be exported, gives one held-out view."""
    config = trainer.config
    milliseconds = []
    with one_torch_thread(), torch.no_grad():
        gaussians = trainer.method.modulate(trainer.gaussians)
        for _ in range(RENDERS):
            for view in trainer.scene.test:
                started = time.perf_counter()
                render_view(gaussians, view.camera, config.sh_degree, config.background)
                milliseconds.append(1_000 * (time.perf_counter() - started))
    return float(np.median(milliseconds))
