"""The benchmark `parts`: what each part of hqgs costs in lines and seconds, and gains on held-out photos.

A run leaves out one part. Where that changes neither plan nor start the part is off, and nothing is trained.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import inspect
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import grimp
from pandas import DataFrame

from benchmarks.command import Benchmark
from benchmarks.measure import Run, Training
from benchmarks.pages.figures import and_list, gain, number, pick, table
from benchmarks.protocol import Row, read_protocols
from benchmarks.rows import text_of
from benchmarks.study import Cell, Study, begin
from benchmarks.without import without
from hqgs.evaluation.held_out import measured
from hqgs.evaluation.metrics import mean_metrics
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.training.config import AUTO, NONE
from hqgs.training.trainer import Trainer

ALL = "all"
MEASURES = ("psnr", "psnr_aligned", "psnr_shown", "ssim", "cpu_seconds", "placed", "gaussians")


@dataclass(frozen=True)
class Part(Row):
    """A part, and how a run goes without it."""

    method: str = AUTO
    leave_out: str = AUTO
    what: str = ""  # it does
    modules: tuple[str, ...] = ()  # where it is: `package.module`, `package.module:function`
    without: dict[str, str] = field(default_factory=dict)  # what its functions become, by their places
    poses: bool = False  # whether it concerns how cameras are found

    @property
    def more(self) -> dict[str, Any]:
        return {**super().more, "without": self.without, "poses": self.poses}


PROTOCOLS = read_protocols(Path(__file__).with_suffix(".toml"), Part)
PARTS = {part.label: part for part in PROTOCOLS["standard"].rows if isinstance(part, Part)}


@cache
def imports() -> grimp.ImportGraph:
    return grimp.build_graph("hqgs", cache_dir=None)


def alone(modules: Sequence[str]) -> set[str]:
    """The modules, and those that nothing else imports."""
    graph, found = imports(), set(modules)
    while more := {
        below
        for module in found
        for below in graph.find_modules_directly_imported_by(module) - found
        if graph.find_modules_that_directly_import(below) <= found
    }:
        found |= more
    return found


def length(place: str) -> int:
    """Lines of a module or a function."""
    module, _, name = place.partition(":")
    found = importlib.import_module(module)
    return len(inspect.getsource(attrgetter(name)(found) if name else found).splitlines())


def lines_of(part: Part) -> int:
    """Lines that go with the part."""
    whole = alone([place for place in part.modules if ":" not in place])
    return sum(map(length, [*whole, *(place for place in part.modules if ":" in place)]))


def told(part: Part) -> Run:
    """What the table says of a part, also after it has left."""
    return {"what": part.what, "lines": lines_of(part)}


class Parts:
    """The runs of a study."""

    def __init__(self, study: Study) -> None:
        self.study = study
        self.whole = {cell.group: cell for cell in study.cells if cell.row.label == ALL}
        self.folders = {scene.name: path for scene, path in zip(study.scenes, study.args.scenes, strict=True)}

    def measure(self, cell: Cell, photos: Scene) -> Run:
        part = cell.row
        assert isinstance(part, Part)
        what = told(part)  # with the functions as they are
        with without(part.without):
            if part.poses:
                photos = self.placed_anew(cell)
            done = Training(photos, cell.config)
            start = print_of(done.trainer)
            known = self.study.runs.get(self.whole[cell.group])
            if known is not None and known["start"] == start:
                whole = {name: float(known[name]) for name in MEASURES}
                return whole | {"on": False, "start": start} | what
            done.steps()
        placed = len(photos.train) + len(photos.test)
        cpu = done.setup_cpu_seconds + done.cpu_seconds
        mean = asdict(mean_metrics(measured(done.held_out())))
        if mean["psnr_shown"] is None:  # no camera has a look
            mean["psnr_shown"] = mean["psnr"]
        found = mean | done.record() | {"cpu_seconds": cpu, "placed": placed}
        whole = {name: found[name] for name in MEASURES}
        same = ("psnr", "ssim", "gaussians")
        on = part.label == ALL or known is None or any(text_of(whole[one]) != known[one] for one in same)
        return whole | {"on": on, "start": start} | what

    def placed_anew(self, cell: Cell) -> Scene:
        """The scene with cameras that are found without the part. ValueError where photos are degraded or few
        of a capture, whose cameras are those of the whole."""
        keep = self.study.args.out / "scenes" / f"{cell.scene.name} without {cell.row.label}"
        longest = self.study.protocol.longest
        if cell.degradation != NONE or self.study.protocol.photos is not None:
            raise ValueError(f"{cell.row.label}: cameras are found anew in captures as they are")
        return load_scene(
            self.folders[cell.scene.name], downscale=cell.downscale, keep_sfm=keep, longest=longest
        )


def print_of(trainer: Trainer) -> str:
    """What a run does follows from: its plan, photos, masks and first Gaussians."""
    plan = {name: value for name, value in asdict(trainer.plan).items() if name != "rows"}
    sha = hashlib.sha256(repr(_without_nothing(plan)).encode())
    for view in trainer.scene.train:
        sha.update(view.name.encode() + view.camera.viewmat.tobytes())
        sha.update(b"" if view.mask is None else view.mask.tobytes())
    for tensor in trainer.gaussians.named().values():
        sha.update(tensor.detach().numpy().tobytes())
    return sha.hexdigest()[:8]


def _without_nothing(value: Any) -> Any:
    """Without what is 0, False, empty or None: all say that something is not done."""
    if isinstance(value, dict):
        return {name: _without_nothing(one) for name, one in value.items() if one}
    return value


def gains_of(runs: DataFrame, label: str, value: str = "psnr") -> Any:
    """What a part adds to runs in which it is on."""
    on = runs.loc[(runs["row"] == ALL) | runs["on"].astype(bool)]
    return gain(on, ALL, label, value)


def lengths(runs: DataFrame) -> str:
    """Of the runs: `400 and 1,000`."""
    return and_list([f"{iterations:,.0f}" for iterations in sorted(set(runs["iterations"]))])


def parts_table(runs: DataFrame) -> str:
    """A line for each part that is on anywhere, the largest gain first; then the names of the others."""
    body, off = list[tuple[float, list[str]]](), list[str]()
    some_lost = runs.groupby("scene")["placed"].nunique().max() > 1  # without a part of poses
    for label in dict.fromkeys(runs["row"]):
        mine = pick(runs, row=label)
        if label == ALL or label not in PARTS:  # that have left
            continue
        scenes = mine.groupby("scene")["on"].any()
        if not scenes.to_numpy().any():
            off.append(label)
            continue
        gains = {name: gains_of(runs, label, name) for name in MEASURES}
        decibels = [gains[name] for name in ("psnr", "psnr_aligned", "psnr_shown")]
        cells = [f"{label}: {mine['what'].iloc[-1]}", number(mine["lines"].max() or None, ".0f")]
        cells += [f"{scenes.sum():.0f} of {len(scenes)}", *(one.text() for one in decibels)]
        cells += [gains["ssim"].text("+.3f"), number(gains["cpu_seconds"].mean, "+.0f")]
        cells += [number(gains["placed"].runs["gain"].sum(), "+.0f")] if some_lost else []
        body.append((decibels[0].mean if decibels[0].count else float("-inf"), cells))
    heads = (
        "part",
        "lines",
        "on in",
        "PSNR (dB)",
        "brightness set aside (dB)",
        "as shown (dB)",
        "SSIM",
        "CPU (s)",
        *(["photos placed"] if some_lost else []),
    )
    lines = table(heads, [cells for _, cells in sorted(body, key=lambda one: -one[0])])
    return f"{lines}\n\nOff in all of these runs: {and_list(off)}." if off else lines


def run(args: argparse.Namespace) -> list[str]:
    """Train what is not finished."""
    rows = None if args.rows is None else list(dict.fromkeys([ALL, *args.rows]))
    study = begin(args, PROTOCOLS, rows=rows)
    study.train(Parts(study).measure)
    runs = study.frame()
    return [*([parts_table(runs)] if len(runs) else []), *study.missing()]


OPTIONS = {"--degradations": {"nargs": "+", "metavar": "KIND", "help": "done to the photos first (none)"}}
BENCHMARK = Benchmark("what each part of hqgs costs and gains", run, PROTOCOLS, OPTIONS)
