"""The benchmark `looks`: what photos and cameras do of their own, if it is found, and what learning it gains.

Clean photos, or with a look put on them. What the diagnosis finds is trained with and without, and what was
put on in any case; a capture in which nothing is found is not trained.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame

from benchmarks.command import Benchmark
from benchmarks.measure import Run
from benchmarks.pages.figures import number, pick, table
from benchmarks.protocol import Row, read_protocols
from benchmarks.rows import pairs_of
from benchmarks.study import Cell, finished
from hqgs.diagnosis.scene import Inspector
from hqgs.evaluation.metrics import psnr_aligned
from hqgs.photos.formula import LEARNED, NONE, parse_formation
from hqgs.photos.look import Look, respond
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.scene import Scene, View
from hqgs.training.config import AUTO
from hqgs.training.frame import Frame
from hqgs.training.trainer import Trainer

AS_THEY_ARE, FOUND = "as they are", ("found", "learned")
CAMERAS = "a", "b"  # that take photos in turn, where a response is put on


@dataclass(frozen=True)
class Taken(Row):
    """A look that is put on photos."""

    method: str = AUTO
    leave_out: str = AUTO
    put: dict[str, float] = field(default_factory=dict)

    @property
    def more(self) -> dict[str, Any]:
        return {"put": self.put}


PROTOCOLS = read_protocols(Path(__file__).with_suffix(".toml"), Taken)


def put_on(scene: Scene, put: dict[str, float], seed: int) -> tuple[Scene, dict[str, Look]]:
    """The scene by cameras with these looks, and the look of each of its photos."""
    rng, looks = np.random.default_rng([seed, 9]), dict[str, Look]()

    def taken(view: View) -> View:
        device, stops = CAMERAS[len(looks) % 2 if "response" in put else 0], put.get("exposure", 0.0)
        response = put.get("response", 0.0) * np.array([[1.0] * 3, [0.0] * 3]) * (1 if device == "a" else -1)
        gains = 2 ** rng.uniform(-stops, stops, 3)
        looks[view.name] = Look(gains, np.array([put.get("vignetting", 0.0), 0.0]), response)
        image = to_uint8(looks[view.name].of(as_floats(view.image), view.camera.K).clip(0, 1))
        return replace(view, image=image, device=device)

    if not put:
        return scene, looks
    return replace(scene, train=[*map(taken, scene.train)], test=[*map(taken, scene.test)]), looks


def curves_of(looks: list[Look], kind: str) -> NDArray[np.float64]:
    """What one kind of a look does to each photo, as far as photos can tell it, [N, K]: the logarithms of
    gains, of what a lens takes by r^2, and what a response adds by value."""
    steps = np.linspace(0, 1, 17)
    if kind == "vignetting":
        return np.array([steps * (look.vignetting @ [np.ones(17), steps]) for look in looks])
    values = torch.from_numpy(steps).expand(3, 1, -1)
    bends = [(respond(values, torch.from_numpy(look.response)) - values).numpy().ravel() for look in looks]
    each = np.array(bends if kind == "response" else [np.log(look.gains) for look in looks])
    return each - each.mean(0)


def measure(cell: Cell, photos: Scene) -> Run:
    assert isinstance(cell.row, Taken)
    (scene, looks), inspector = put_on(photos, cell.row.put, cell.seed), Inspector()
    formation = inspector.diagnose(scene).formation
    found = [step.kind for step in parse_formation(formation).steps if step.kind in LEARNED]
    run: Run = {"found": "+".join(found), "learned": "", "psnr": None, "psnr_shown": None}
    run |= {"gain": {}, "gain_shown": {}, "off": {}}
    if not found and not cell.row.put:
        return run
    plan = Trainer(Frame.of(scene), cell.config, inspector).plan
    kinds = [str(step) for step in parse_formation(plan.settings.hqgs.formation).steps]

    @cache
    def trained(formation: str) -> tuple[NDArray[np.float64], list[Look]]:
        """Held-out PSNR in the look of their camera and, of clean photos, as shown; and what was learned."""
        asked = replace(cell.config, hqgs=replace(cell.config.hqgs, formation=formation))
        trainer = Trainer(Frame.of(scene), asked, inspector)
        while trainer.iteration < trainer.length:
            trainer.step()
        values = [
            [psnr_aligned(view.render, view.photo, view.mask), psnr_aligned(shown, clean.image, view.mask)]
            for view, clean in zip(trainer.held_out(), photos.test, strict=True)
            for shown in [view.render if view.shown is None else view.shown]
        ]
        return np.array(values, np.float64).mean(0), [photo.look for photo in trainer.method.learned()]

    look, shown = trained("+".join(kinds) or NONE)[0].tolist()
    run |= {"learned": "+".join(kind for kind in kinds if kind in LEARNED), "psnr": look, "psnr_shown": shown}
    for kind in dict.fromkeys([*found, *cell.row.put]):
        others = [one for one in kinds if one != kind]
        with_it, without = trained("+".join([*others, kind])), trained("+".join(others) or NONE)
        run["gain"][kind], run["gain_shown"][kind] = (with_it[0] - without[0]).tolist()
        if kind in cell.row.put:
            true = curves_of([looks[view.name] for view in scene.train], kind)
            off = np.abs(curves_of(with_it[1], kind) - true).max(1).mean()
            run["off"][kind] = float(off / np.abs(true).max(1).mean())
    return run


def looks_table(runs: DataFrame) -> str:
    """A line for each look that is put on, over captures and seeds."""
    body = list[list[str]]()
    for photos in dict.fromkeys(runs["row"]):
        lines = pick(runs, row=photos).to_dict("records")
        kind = str(photos).split()[0]
        cells = [f"{sum(kind in line[name].split('+') for line in lines)} of {len(lines)}" for name in FOUND]
        if photos == AS_THEY_ARE:
            cells = [f"{sum(bool(line[name]) for line in lines)} of {len(lines)}" for name in FOUND]
        for name, form in (("gain", "+.2f"), ("gain_shown", "+.2f"), ("off", ".0%")):
            values = [value for line in lines for one, value in pairs_of(line[name]) if one == kind]
            cells.append(number(float(np.mean(values)) if values else None, form))
        body.append([str(photos), *cells])
    return table(("photos", "found", "on", "gain (dB)", "gain as shown (dB)", "off by"), body)


def run(args: argparse.Namespace) -> list[str]:
    study, runs = finished(args, PROTOCOLS, measure)
    return [*([looks_table(runs)] if len(runs) else []), *study.missing()]


BENCHMARK = Benchmark("what photos and cameras do of their own: found, learned, gained", run, PROTOCOLS)
