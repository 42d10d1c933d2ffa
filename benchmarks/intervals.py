"""The benchmark `intervals`: how often an interval over a few held-out photos holds the mean over many.

The room is trained on few photos and photographed, by ray-casting, from many places; some of these at a time
are drawn as held-out photos are. The mean over all of them is what an interval should hold.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.command import Benchmark
from benchmarks.measure import Training
from benchmarks.pages.figures import listed
from benchmarks.protocol import Row
from benchmarks.rows import Table, facts
from hqgs.evaluation.held_out import held_out_renders, measured
from hqgs.evaluation.intervals import half_width
from hqgs.evaluation.metrics import ViewMetrics
from hqgs.scene.builtin import render_view
from hqgs.scene.builtin.sparse import ARC, HIGH, LOW, RADIUS, SIDEWAYS, beyond_room, camera_on_arc
from hqgs.scene.scene import Scene, View

DRAWN = (2, 3, 4, 6, 10, 20)  # photos
NAMES = ("psnr", "ssim", "haarpsi")
SHOWN = {
    "scene": ("scene", ""),
    "photos": ("photos", ""),
    "draws": ("draws", ""),
    **{
        name: (f"{label} held", ".3f") for name, label in zip(NAMES, ("PSNR", "SSIM", "HaarPSI"), strict=True)
    },
    "psnr_difference": ("difference held", ".3f"),
    "half": ("± (dB)", ".2f"),
    "half_difference": ("± of a difference (dB)", ".2f"),
    "deviation": ("deviation of photos (dB)", ".2f"),
}


def places(count: int, beyond: bool, width: int, height: int) -> list[View]:
    """Photos from places around the table, or also from past the ends of where it was photographed."""
    rng, views = np.random.default_rng(2026), list[View]()
    reach = ARC + SIDEWAYS if beyond else ARC
    for k in range(count):
        radius = RADIUS * rng.uniform(0.8, 1.1) if beyond else RADIUS
        jitter = rng.uniform(-1, 1, 7)
        camera = camera_on_arc(
            rng.uniform(-reach, reach), rng.uniform(HIGH, LOW), jitter, width, height, radius
        )
        views.append(View(f"{k:03}", camera, render_view(camera)))
    return views


def pools(scene: Scene, sets: list[list[View]], iterations: int) -> list[list[list[ViewMetrics]]]:
    """What the photos of each set measure of a scene, after three quarters of its training and at the end."""
    done, found = Training(scene, Row("3dgs").train_config(0, iterations, {})), []
    for steps in (iterations * 3 // 4, iterations - iterations * 3 // 4):
        done.steps(steps)
        shown = done.trainer.model()
        found.append([measured(held_out_renders(replace(scene, test=views), shown)) for views in sets])
    return found


def held(
    draws: list[np.ndarray], values: np.ndarray, half_of: Callable[[list[float]], float | None]
) -> tuple[float, float]:
    """Share of the draws whose interval holds the mean of all, and the mean half of an interval."""
    halves = [half_of(values[draw].tolist()) or 0.0 for draw in draws]
    hits = [abs(values[d].mean() - values.mean()) <= half for d, half in zip(draws, halves, strict=True)]
    return float(np.mean(hits)), float(np.mean(halves))


def run(args: argparse.Namespace) -> list[str]:
    """Train, measure all photos once, and draw some of them many times."""
    count, draws, iterations, width = (40, 20, 20, 48) if args.quick else (80, 200, 300, 96)
    height, lines, rng = width * 3 // 4, list[dict[str, Any]](), np.random.default_rng(0)
    for photos, kinds in ((12, (False, True)), (24, (False,))):
        print(f"intervals: the room by {photos} photos", file=sys.stderr)
        scene = beyond_room(photos, None, width, height)
        sets = [places(count, beyond, width, height) for beyond in kinds]
        for beyond, *moments in zip(kinds, *pools(scene, sets, iterations), strict=True):
            other, one = (
                {m: np.array([getattr(view, m) for view in of], float) for m in NAMES} for of in moments
            )
            name = f"the room by {photos} photos{', also from beyond them' if beyond else ''}"
            for drawn in DRAWN:
                some = [rng.choice(count, drawn, replace=False) for _ in range(draws)]
                line: dict[str, Any] = {"scene": name, "photos": drawn, "draws": draws}
                for metric, of in one.items():
                    line[metric], half = held(some, of, lambda values, m=metric: half_width(values, m))
                    line |= {"half": half} if metric == "psnr" else {}
                apart = one["psnr"] - other["psnr"]
                line["psnr_difference"], line["half_difference"] = held(some, apart, half_width)
                lines.append(line | {"deviation": float(one["psnr"].std())} | facts())
    table = Table(args.out / "intervals.csv")
    return [listed(table.frame(table.put(lines)), SHOWN)]


BENCHMARK = Benchmark("how often intervals of held-out metrics hold what they should", run)
