"""One engine for all studies: rows x degradations x scenes x seeds become runs, a line of a table each.

A run is taken up again where the table has a line of its key that was made by the same sources from the same
input. `digest` is that of what a result follows from: configuration, photos, cameras and points, what is done
to the photos, version; `sources` that of the package's files (but for the command line) and of the crate's.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Any

from pandas import DataFrame

import hqgs
from benchmarks.measure import Run
from benchmarks.protocol import Protocol, Row, degraded, load_scenes, narrowed
from benchmarks.rows import KEYS, Table, facts
from hqgs.cli.progress import duration
from hqgs.photos.formula import NONE
from hqgs.scene.names import KEPT
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.reconstruct import sfm_scene
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.config import METHODS, TrainConfig
from hqgs.training.trainer import TrainingError

NO_RESULT = "cli"  # of the package: what no result depends on
OWN, PHOTOS = "own", "photos"  # where poses and points are from: the scene, or the degraded photos


@dataclass(frozen=True, eq=False)
class Cell:
    """One training run of a study."""

    scene: Scene  # before anything is done to its photos
    row: Row
    config: TrainConfig
    degradation: str = NONE
    downscale: float = 1.0
    poses: str = OWN
    more: Mapping[str, Any] = field(default_factory=dict)  # that the result depends on, beside all these

    @property
    def seed(self) -> int:
        return self.config.seed

    @property
    def group(self) -> tuple[str, str, int]:
        """What it shares with the other rows: scene, degradation, seed."""
        return self.scene.name, self.degradation, self.seed

    @property
    def key(self) -> dict[str, Any]:
        """The columns that tell its line in the table from others."""
        return {
            "scene": self.scene.name,
            "degradation": self.degradation,
            "row": self.row.label,
            "seed": self.seed,
            "iterations": self.config.iterations,
            "downscale": float(self.downscale),
            "poses": self.poses,
        }

    def __str__(self) -> str:
        parts = [self.scene.name, *([self.degradation] if self.degradation != NONE else []), self.row.label]
        return ", ".join([*parts, f"seed {self.seed}"])


def grid(protocol: Protocol, scenes: Sequence[Scene], poses: str = OWN) -> list[Cell]:
    """All cells of these scenes, the seeds outermost: whole tables come early. The rows are innermost."""
    return [
        Cell(scene, row, protocol.train_config(row, seed), kind, protocol.downscale, poses, row.more)
        for seed, scene, kind, row in product(protocol.seeds, scenes, protocol.degradations, protocol.rows)
    ]


@cache
def sources() -> str:
    """A digest of the files that make a result: of hqgs, and of the crate where there is a checkout."""
    package = Path(hqgs.__file__).parent
    files = [p for p in package.rglob("*.py") if p.relative_to(package).parts[0] != NO_RESULT]
    if (package.parent / "Cargo.toml").is_file():
        files += [*(package.parent / "rust").rglob("*.rs"), package.parent / "Cargo.lock"]
    sha = hashlib.sha256()
    for path in sorted(files):
        sha.update(f"{path.relative_to(package.parent).as_posix()}\n".encode() + path.read_bytes())
    return sha.hexdigest()[:8]


def digest_of(cell: Cell, fingerprint: dict[str, str]) -> str:
    """A digest of all that the result depends on. `fingerprint`: of the cell's scene.

    Options of other methods do not count, nor does the name of the row.
    """
    config = asdict(cell.config)
    config = {name: value for name, value in config.items() if name not in METHODS or name == cell.row.method}
    given = {"version": hqgs.__version__, "config": config, "degradation": cell.degradation}
    given |= {"scene": fingerprint, "poses": cell.poses, **cell.more}
    return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:12]


class Study:
    """Runs what is not finished, and knows what is: `runs` and `failures` by cell."""

    def __init__(self, args: argparse.Namespace, name: str, protocol: Protocol, scenes: list[Scene]) -> None:
        """The table is in `args.out`; runs that are judged by training photos have one of their own."""
        self.args, self.name, self.protocol, self.scenes = args, name, protocol, scenes
        self.cells = grid(protocol, scenes, PHOTOS if args.sfm else OWN)
        file = f"{name}_validation.csv" if args.validate else f"{name}.csv"
        self.table = Table(args.out / file, KEYS[name])
        self._last: tuple[tuple[str, str, int], Scene] | None = None
        self.search_cpu_s = 0.0  # of all processes that found the poses of the last photos; 0: they were kept
        prints = {scene.name: scene_fingerprint(scene) for scene in scenes}
        self.digests = {cell: digest_of(cell, prints[cell.scene.name]) for cell in self.cells}
        lines = self.table.lines()
        found = {cell: lines.get(self.table.key_of(cell.key)) for cell in self.cells}
        self.runs = {
            cell: line
            for cell, line in found.items()
            if line and (line.get("digest"), line.get("sources")) == (self.digests[cell], sources())
        }
        self.failures: dict[Cell, str] = {}

    def train(self, measure: Callable[[Cell, Scene], Run]) -> None:
        """Run the cells that are not finished, in their order; each is written as soon as it is done.

        `measure` trains a cell on the photos that it gets, and returns the further columns of its line. A
        ValueError or TrainingError of one cell does not end the others. With `--finished` nothing is run.
        """
        if self.args.finished:
            return
        pending = [cell for cell in self.cells if cell not in self.runs]
        self.say(f"{len(self.cells)} runs, {len(pending)} left")
        walls: list[float] = []  # seconds of the runs so far
        for k, cell in enumerate(pending, 1):
            started = time.perf_counter()
            try:
                run = measure(cell, self.photos(cell))
            except (ValueError, TrainingError) as error:
                self.failures[cell] = str(error)
                self.say(f"[{k}/{len(pending)}] {cell} failed: {error}")
                continue
            walls.append(time.perf_counter() - started)
            run = cell.key | run | facts() | {"sources": sources(), "digest": self.digests[cell]}
            self.runs[cell] = self.table.put([run])[0]
            value, left = run.get("psnr"), len(pending) - k
            self.say(
                f"[{k}/{len(pending)}] {cell}: {'no PSNR' if value is None else f'{value:.2f} dB'}, "
                f"{duration(walls[-1])}; {left} left"
                + (f", about {duration(left * mean(walls))}" if left else "")
            )

    def photos(self, cell: Cell) -> Scene:
        """What a cell trains on, the same for all rows: degraded photos, with `--sfm` poses from them."""
        if self._last is None or self._last[0] != cell.group:
            scene = degraded(cell.scene, cell.degradation, cell.seed)
            before = _children_cpu_s()
            self._last = (cell.group, sfm_scene(scene, self.args.out / KEPT) if self.args.sfm else scene)
            self.search_cpu_s = _children_cpu_s() - before
        return self._last[1]

    def beside(self, cell: Cell, name: str) -> Path:
        """Where a cell's run keeps a file, in a folder that is there."""
        path = self.args.out / "runs" / f"{self.digests[cell]}-{sources()}" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def frame(self) -> DataFrame:
        """The finished runs, in the order of the cells."""
        return self.table.frame([self.runs[cell] for cell in self.cells if cell in self.runs])

    def missing(self) -> list[str]:
        """Why the other runs are not there, a line each."""
        why = {cell: self.failures.get(cell, "not finished") for cell in self.cells if cell not in self.runs}
        return [f"left out: run {cell}: {reason}" for cell, reason in why.items()]

    def say(self, text: str) -> None:
        print(f"{self.name}: {text}", file=sys.stderr, flush=True)


def _children_cpu_s() -> float:
    times = os.times()
    return times.children_user + times.children_system


def chosen(
    args: argparse.Namespace, protocols: Mapping[str, Protocol], **changes: Any
) -> tuple[Protocol, list[Scene]]:
    """One of the protocols, which the options of `add_options`, and then `changes`, narrow; its scenes."""
    name = "quick" if args.quick else args.protocol
    options = ("degradations", "rows", "seeds", "iterations", "downscale", "photos")
    given = {option: vars(args).get(option) for option in options} | changes
    protocol = narrowed(protocols[name], **given)
    return protocol, load_scenes(args.scenes, protocol, args.out / "scenes", args.validate)


def begin(args: argparse.Namespace, protocols: Mapping[str, Protocol], **changes: Any) -> Study:
    """The study of what was chosen."""
    return Study(args, args.benchmark, *chosen(args, protocols, **changes))


def finished(
    args: argparse.Namespace, protocols: Mapping[str, Protocol], measure: Callable[[Cell, Scene], Run]
) -> tuple[Study, DataFrame]:
    """The study of `begin`, trained, and its finished runs."""
    study = begin(args, protocols)
    study.train(measure)
    return study, study.frame()
