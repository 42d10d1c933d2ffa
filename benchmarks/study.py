"""One engine for all studies: rows x degradations x scenes x seeds become runs, kept in a folder as JSON.

A run is taken up again where a file has its key and was made by the same sources. The key is a digest of what
a result follows from: configuration, photos, cameras and points, what is done to the photos, version. The
sources are a digest of the package's files (but for the command line) and of the crate's. Each run also says
its commit, machine and number of threads.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import time
from collections import defaultdict
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
from benchmarks.output import Report
from benchmarks.protocol import Protocol, Row, degraded, load_scenes, narrowed
from hqgs.base.files import KEPT, write_json
from hqgs.base.machine import machine_facts, version_facts
from hqgs.cli.progress import duration
from hqgs.photos.formula import NONE
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.reconstruct import sfm_scene
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.config import METHODS, PAPER, TrainConfig
from hqgs.training.trainer import TrainingError

FORMAT = 1  # raised when a run records something else
NO_RESULT = "cli"  # of the package: what no result depends on


@dataclass(frozen=True, eq=False)
class Cell:
    """One training run of a study."""

    scene: Scene  # before anything is done to its photos
    row: Row
    config: TrainConfig
    degradation: str = NONE
    downscale: float = 1.0
    tags: tuple[str, ...] = ()  # for the file's name
    more: Mapping[str, Any] = field(default_factory=dict)  # that the result depends on, beside all these

    @property
    def seed(self) -> int:
        return self.config.seed

    @property
    def group(self) -> tuple[str, str, int]:
        """What it shares with the other rows: scene, degradation, seed."""
        return self.scene.name, self.degradation, self.seed

    def __str__(self) -> str:
        parts = [self.scene.name, *([self.degradation] if self.degradation != NONE else []), self.row.label]
        return ", ".join([*parts, f"seed {self.seed}"])


def grid(protocol: Protocol, scenes: Sequence[Scene], labelled: bool = False, *tags: str) -> list[Cell]:
    """All cells of these scenes, the seeds outermost: whole tables come early. The rows are innermost.

    The files' names hold the tags, and the labels of the rows where they are `labelled`.
    """
    more = {"sfm": True} if "sfm" in tags else {}
    cells = []
    for seed, scene, kind, row in product(protocol.seeds, scenes, protocol.degradations, protocol.rows):
        names = (*([row.label] if labelled else []), *tags)
        config = protocol.train_config(row, seed)
        cells.append(Cell(scene, row, config, kind, protocol.downscale, names, row.more | more))
    return cells


class Store:
    """`runs/VERSION-SOURCES/KEY.json` for each finished run, and a folder `KEY` for what it keeps beside.

    A run that failed holds `error`, and is to be tried again. `known`: result files of this benchmark, whose
    runs count where there is none here, without what lies beside. ValueError where one is no such file.
    """

    def __init__(self, root: Path, known: Sequence[Path] = ()) -> None:
        self.here = root / "runs" / f"{hqgs.__version__}-{sources()}"
        self.known: dict[str, Run] = {}
        for path in known:
            try:
                runs = json.loads(path.read_text(encoding="utf-8"))["results"]["runs"]
                self.known |= {run["key"]: run for run in runs}
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(f"known: {path} holds no runs of this benchmark: {error!r}") from error

    def read(self, key: str) -> Run | None:
        """The finished run, else the failed one, else None; ValueError for a damaged file."""
        path = self.here / f"{key}.json"
        if not path.is_file():
            return self.known.get(key)
        try:
            run = json.loads(path.read_text(encoding="utf-8"))
            if run["key"] != key:
                raise ValueError(f"it holds the run {run['key']}")
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error!r}; remove it, and the run is repeated") from error
        return self.known.get(key, run) if "error" in run else run

    def write(self, run: Run) -> None:
        write_json(self.here / f"{run['key']}.json", run)

    def beside(self, key: str, name: str) -> Path:
        """Where a run keeps a file: to be written before the run is, which vouches for it."""
        return self.here / key / name


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


def key_of(cell: Cell, fingerprint: dict[str, str]) -> str:
    """Readable, and a digest of all that the result depends on. `fingerprint`: of the cell's scene.

    Options of other methods do not count, nor does the name of the row: a run serves all protocols.
    """
    row, config = cell.row, asdict(cell.config)
    config = {name: value for name, value in config.items() if name not in METHODS or name == row.method}
    if not config["leave_out"]:
        del config["leave_out"]  # runs from before there was such a choice are the same
    paper = row.method == "hqgs" and cell.config.hqgs.guidance == PAPER
    if config["brisk"] is None and (paper or row.method in ("3dgs", "srgs")):
        del config["brisk"]  # so are those of methods without higher rates
    if config.get("hqgs", {}).get("held_pixels"):
        del config["hqgs"]["held_pixels"]  # so are those from before they could be switched off
    if paper:
        del config["hqgs"]["first_points"]  # and the paper's, which has no use for it
    facts = {"format": FORMAT, "version": hqgs.__version__, "config": config, "degradation": cell.degradation}
    facts |= {"scene": fingerprint, **cell.more}
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]
    method = cell.more.get("rival", row.method)
    parts = [cell.scene.name, f"x{cell.downscale:g}", cell.degradation, method, f"s{cell.seed}"]
    parts += [str(cell.config.iterations), *cell.tags, digest]
    return re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts))


class Study:
    """Runs what is not finished, and knows what is: `runs` and `failures` by cell."""

    def __init__(
        self, args: argparse.Namespace, name: str, protocol: Protocol, scenes: list[Scene], labelled: bool
    ) -> None:
        """`labelled`: see `grid`. The store is in `args.out`, with the runs that `args.known` holds."""
        self.args, self.name, self.protocol, self.scenes = args, name, protocol, scenes
        self.tags = [tag for tag, on in (("validation", args.validate), ("sfm", args.sfm)) if on]
        self.cells = grid(protocol, scenes, labelled, *self.tags)
        self.store = Store(args.out, args.known or ())
        self._last: tuple[tuple[str, str, int], Scene] | None = None
        prints = {scene.name: scene_fingerprint(scene) for scene in scenes}
        self.keys = {cell: key_of(cell, prints[cell.scene.name]) for cell in self.cells}
        found = {cell: self.store.read(key) for cell, key in self.keys.items()}
        self.runs: dict[Cell, Run] = {cell: run for cell, run in found.items() if run and "error" not in run}
        self.failures = {cell: run["error"] for cell, run in found.items() if run and "error" in run}

    def train(self, measure: Callable[[Cell, Scene], Run]) -> None:
        """Run the cells that are not finished, in their order; each is written as soon as it is done.

        `measure` trains a cell on the photos that it gets. A ValueError or TrainingError of one cell is kept
        and does not end the others; it is tried again by the next call. With `--finished` nothing is run.
        """
        if self.args.finished:
            return
        pending = [cell for cell in self.cells if cell not in self.runs]
        self.say(f"{len(self.cells)} runs, {len(pending)} left")
        walls: list[float] = []  # seconds of the runs so far
        facts = {"sources": sources(), "machine": machine_facts(), "versions": version_facts()}
        for k, cell in enumerate(pending, 1):
            key, started = self.keys[cell], time.perf_counter()
            try:
                run = measure(cell, self.photos(cell))
            except (ValueError, TrainingError) as error:
                self.failures[cell] = str(error)
                self.store.write({"key": key, "error": str(error), **facts})
                self.say(f"[{k}/{len(pending)}] {cell} failed: {error}")
                continue
            walls.append(time.perf_counter() - started)
            run = {"key": key, "scene": cell.scene.name, **run, "threads": hqgs.get_num_threads()}
            self.runs[cell] = run | {"wall_seconds": walls[-1], **facts}
            self.store.write(self.runs[cell])
            self.failures.pop(cell, None)
            value = run["history"][-1]["psnr"] if run["history"] else None
            left = len(pending) - k
            self.say(
                f"[{k}/{len(pending)}] {cell}: {'no PSNR' if value is None else f'{value:.2f} dB'}, "
                f"{run['gaussians']:,} Gaussians, {duration(walls[-1])}; {left} left"
                + (f", about {duration(left * mean(walls))}" if left else "")
            )

    def photos(self, cell: Cell) -> Scene:
        """What a cell trains on, the same for all rows: degraded photos, with `--sfm` poses from them."""
        if self._last is None or self._last[0] != cell.group:
            scene = degraded(cell.scene, cell.degradation, cell.seed)
            self._last = (cell.group, sfm_scene(scene, self.args.out / KEPT) if self.args.sfm else scene)
        return self._last[1]

    def beside(self, cell: Cell, name: str) -> Path:
        """Where a cell's run keeps a file, in a folder that is there."""
        path = self.store.beside(self.keys[cell], name)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def report(self, part: str = "") -> Report:
        """A report that holds nothing yet but what was run, and why the other runs are not there."""
        settings = asdict(self.protocol) | {"scenes": [scene.name for scene in self.scenes]}
        settings |= {"validation": self.args.validate, "sfm": self.args.sfm, **self.circumstances()}
        missing = [cell for cell in self.cells if cell not in self.runs]
        why = [{"what": f"run {cell}", "why": self.failures.get(cell, "not finished")} for cell in missing]
        return Report(settings, part, left_out=why)

    def results(self) -> list[Run]:
        """The finished runs with the labels of their rows, in the order of the cells."""
        return [self.runs[c] | {"row": c.row.label} for c in self.cells if c in self.runs]

    def circumstances(self) -> dict[str, list[str]]:
        """CPU, threads, commit and sources of the finished runs, each value once."""
        seen: defaultdict[str, set[str]] = defaultdict(set)
        for run in self.runs.values():
            seen["CPU"].add(" ".join(filter(None, map(run["machine"].get, ("cpu", "simd")))))
            seen["threads"].add(str(run["threads"]))
            seen["commit"].add(str(run["versions"]["git_commit"]))
            seen["sources"].add(str(run.get("sources")))
        return {name: sorted(values) for name, values in seen.items()}

    def say(self, text: str) -> None:
        print(f"{self.name}: {text}", file=sys.stderr, flush=True)


def begin(
    args: argparse.Namespace, protocols: Mapping[str, Protocol], labelled: bool = True, **changes: Any
) -> Study:
    """The study of one of the protocols, which the options of `add_options`, and then `changes`, narrow."""
    name = "quick" if args.quick else vars(args).get("protocol", "standard")
    options = ("degradations", "rows", "seeds", "iterations", "downscale", "repeats", "photos")
    given = {option: vars(args).get(option) for option in options} | changes
    protocol = narrowed(protocols[name], **given)
    sources = args.scenes[:1] if protocol.one_scene else args.scenes
    cache = args.out / "scenes"
    scenes = load_scenes(sources, protocol, cache, args.validate)
    return Study(args, args.benchmark, protocol, scenes, labelled)


def finished(
    args: argparse.Namespace, protocols: Mapping[str, Protocol], measure: Callable[[Cell, Scene], Run]
) -> tuple[Study, Report, DataFrame]:
    """The study of `begin`, trained; a report that holds its finished runs, and these as a table."""
    study = begin(args, protocols)
    study.train(measure)
    report = study.report()
    report.results["runs"] = study.results()
    return study, report, DataFrame(study.results())
