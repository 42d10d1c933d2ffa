"""The benchmark `quality`: how near the truth each method comes, over scenes, degradations and seeds."""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pandas import DataFrame

from benchmarks.output import Benchmark, Report
from benchmarks.protocol import Protocol, add_options, narrowed, read_protocols
from benchmarks.quality import tables
from benchmarks.quality.cell import run_cell
from benchmarks.quality.charts import gain_chart, region_chart, time_chart
from benchmarks.quality.pictures import write_sheet
from benchmarks.quality.regions import edge_robustness
from benchmarks.quality.summary import frame_of, summary
from benchmarks.scenes import load_scenes, trained
from benchmarks.study import Cell, Study, grid, open_study
from hqgs.base.files import KEPT, write_text
from hqgs.photos.formula import NONE
from hqgs.scene.scene import Scene

PROTOCOLS = read_protocols(Path(__file__).parent / "protocols.toml")
SMOKE = "smoke"


class Quality:
    """A study and what its tables need to know of it."""

    def __init__(self, args: argparse.Namespace, protocol: Protocol, scenes: list[Scene], report: Report):
        self.args, self.protocol, self.scenes, self.report = args, protocol, scenes, report
        tags = [name for name, on in (("validation", args.validate), ("sfm", args.sfm)) if on]
        more = {"sfm": True} if args.sfm else {}
        cells = grid(protocol, scenes, lambda row: tuple(tags), lambda row: more)
        self.study: Study = open_study(args, "quality", cells, self.photos)

    def photos(self, cell: Cell) -> Scene:
        """What a cell trains on."""
        sfm = self.args.out / KEPT if self.args.sfm else None
        return trained(cell.scene, cell.degradation, cell.seed, sfm)

    def train(self) -> None:
        """Run what is not finished."""
        self.study.train(self.measure)

    def measure(self, cell: Cell, photos: Scene) -> dict[str, Any]:
        renders = self.args.pictures if cell.seed == self.protocol.seeds[0] else 0
        return run_cell(cell, photos, self.study.store, self.study.keys[cell], renders)

    def groups(self) -> list[list[Cell]]:
        """The cells that see the same photos, where every row is finished: only they are compared."""
        found: dict[tuple[str, str, int], list[Cell]] = {}
        for cell in self.study.cells:
            found.setdefault(cell.group, []).append(cell)
        return [group for group in found.values() if all(cell in self.study.runs for cell in group)]

    def frame(self, baseline: str | None) -> DataFrame:
        """A line for each run that is compared."""
        return frame_of(((c, self.study.runs[c]) for group in self.groups() for c in group), baseline)

    def sheets(self, group: list[Cell]) -> None:
        """The picture sheets of a group, if they are not there yet."""
        cell, keys = group[0], [self.study.keys[cell] for cell in group]
        runs = {cell.row.label: self.study.runs[cell] for cell in group}
        digest = hashlib.sha256(" ".join(keys).encode()).hexdigest()[:8]
        for number in range(min(self.args.pictures, len(cell.scene.test))):
            kind = cell.degradation.replace(":", "_")
            name = f"{cell.scene.name}-{kind}-s{cell.seed}-{number}-{digest}.png"
            path = self.args.out / "pictures" / name
            if not (path.is_file() or write_sheet(path, self.study.store, cell.scene, runs, number)):
                self.report.leave_out(f"picture {name}", "the runs did not keep its renders")

    def tables(self) -> None:
        """Everything that the finished runs tell."""
        protocol, report = self.protocol, self.report
        report.left_out += self.study.left_out()
        kinds = [kind for kind in protocol.degradations if kind != NONE]
        maps = []
        for scene in self.scenes:
            try:
                maps.append(edge_robustness(scene, kinds, protocol.seeds[0]))
            except ValueError as error:  # a blur too wide for the photos, which fails the runs as well
                report.leave_out(f"edge maps of {scene.name}", str(error))
        report.results |= {"edge_maps": maps, "runs": self.study.results()}
        if self.groups():
            self.compare()
        if kinds and maps:
            report.tables.append(tables.edge_maps(maps))

    def compare(self) -> None:
        """Tables and charts of the groups in which every row is finished."""
        report, labels = self.report, self.protocol.labels
        for group in self.groups():
            if group[0].seed == self.protocol.seeds[0]:
                self.sheets(group)
        baseline = self.protocol.baseline if self.protocol.baseline in labels and len(labels) > 1 else None
        frame = self.frame(baseline)
        report.results["summary"] = summary(frame, baseline)
        what = self.what(frame)
        report.tables.append(tables.metrics(frame, what))
        if baseline is not None:
            over = f"PSNR gain over {baseline}"
            timed = f"{over} when the faster of the two ends"
            report.tables.append(tables.gains(frame, "gain", over, baseline))
            report.tables.append(tables.gains(frame, "equal_time_gain", timed, baseline))
            report.figures["gains"] = gain_chart(frame, baseline)
        scenes = list(frame["scene"].unique())
        for scene in scenes if len(scenes) > 1 else ():
            part = frame.loc[frame["scene"] == scene]
            report.tables.append(tables.metrics(part, self.what(part), ("psnr", "ssim")))
        report.tables += [tables.training_times(frame), tables.courses(frame)]
        report.tables += [tables.costs(frame, self.circumstances()), tables.regions(frame)]
        guessing = [n for n in labels if any(run["formation"] for run in frame["run"][frame["row"] == n])]
        report.tables += [tables.formations(frame, label) for label in guessing]
        if self.args.sfm:
            report.tables.append(tables.reconstructions(frame))
        report.figures["psnr_vs_time"] = time_chart(frame, what)
        report.figures["regions"] = region_chart(frame)
        for metric, why in sorted({item for run in frame["run"] for item in run["reasons"].items()}):
            report.leave_out(metric, why)

    def what(self, frame: DataFrame) -> str:
        """Which runs the tables are of."""
        scenes, seeds = (", ".join(map(str, frame[name].unique())) for name in ("scene", "seed"))
        validate, sfm = self.args.validate, self.args.sfm
        held = "VALIDATION views (held-out training photos)" if validate else "held-out test views"
        points = "poses and points from the degraded photos" if sfm else "the scenes' own poses and points"
        return (
            f"{held} of {scenes}; {self.protocol.iterations:,} iterations, photos at "
            f"1/{self.protocol.downscale:g}, seeds {seeds}; {points}"
        )

    def circumstances(self) -> str:
        """Machine, threads and commit; a warning where the runs differ in them."""
        kinds = self.study.circumstances()
        self.report.settings |= kinds
        mixed = [name for name, values in kinds.items() if len(values) > 1]
        text = "; ".join(f"{name} {', '.join(values)}" for name, values in kinds.items())
        return text + (f"; MIXED: {', '.join(mixed)}" if mixed else "")


def run(args: argparse.Namespace) -> Report:
    """Run and compare what was asked for."""
    if args.pictures < 0:
        raise ValueError(f"pictures is {args.pictures}, wanted at least 0")
    name = SMOKE if args.quick else args.protocol
    protocol = narrowed(
        PROTOCOLS[name], args.degradations, args.rows, args.seeds, args.iterations, args.downscale
    )
    sources = args.scenes[:1] if protocol.one_scene else args.scenes
    scenes = load_scenes(sources, protocol.downscale, protocol.embedded, args.out / "scenes", args.validate)
    settings = {"protocol": name, **asdict(protocol), "scenes": [s.name for s in scenes]}
    part = name + ("_sfm" if args.sfm else "") + ("_validation" if args.validate else "")
    report = Report(settings | {"validation": args.validate, "sfm": args.sfm}, part)
    quality = Quality(args, protocol, scenes, report)
    if not args.finished:
        quality.train()
    quality.tables()
    write_text(args.out / f"quality_{part}.md", "\n\n".join(report.tables) + "\n")
    return report


def options(parser: argparse.ArgumentParser) -> None:
    add: Any = parser.add_argument
    listed = "; ".join(f"{name}: {protocol.help}" for name, protocol in PROTOCOLS.items())
    add("--protocol", choices=PROTOCOLS, default="standard", metavar="NAME", help=f"{listed} (%(default)s)")
    add_options(parser, PROTOCOLS["standard"])
    add("--degradations", nargs="+", metavar="KIND", help="instead of the protocol's")
    add("--validate", action="store_true", help="for tuning: judge on training photos, leave test views out")
    add("--sfm", action="store_true", help="poses and points from the degraded photos, the same for all rows")
    add("--pictures", type=int, default=1, metavar="N", help="sheets per scene and degradation (%(default)s)")


BENCHMARK = Benchmark("error of each method over scenes, degradations and seeds", options, run)
