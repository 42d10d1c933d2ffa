"""The benchmark `quality`: how near the truth each method comes, over scenes, degradations and seeds."""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.output import Benchmark, Report
from benchmarks.quality import tables as tables
from benchmarks.quality.charts import gain_chart, region_chart, time_chart
from benchmarks.quality.estimate import Estimate, duration
from benchmarks.quality.pictures import write_sheet
from benchmarks.quality.protocols import PROTOCOLS, Cell, Protocol, cells, narrowed
from benchmarks.quality.regions import edge_robustness
from benchmarks.quality.runs import RunStore, run_cell
from benchmarks.quality.scenes import EMBEDDED, load_scenes, trained
from benchmarks.quality.summary import Group, Run, summary
from hqgs.base.files import write_text
from hqgs.base.machine import machine_facts, version_facts
from hqgs.photos.formula import NONE
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.reconstruct import KEPT
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.trainer import TrainingError

SMOKE = "smoke"


@dataclass
class Job:
    """A cell, and its run once it is finished, or why there is none."""

    cell: Cell
    key: str
    run: Run | None
    failure: str | None = None


class Quality:
    """Runs what is not finished and makes the tables of what is."""

    def __init__(
        self, protocol: Protocol, scenes: Sequence[Scene], store: RunStore, pictures: int, report: Report
    ) -> None:
        self.protocol = protocol
        self.scenes = {scene.name: scene for scene in scenes}
        self.store = store
        self.pictures = pictures
        self.report = report
        prints = {name: scene_fingerprint(scene) for name, scene in self.scenes.items()}
        self.jobs = []
        for cell in cells(protocol, list(self.scenes)):
            key = store.key(cell, prints[cell.scene])
            self.jobs.append(Job(cell, key, store.read(key)))
        self._photos: tuple[tuple[str, str, int], Scene] | None = None  # of the last group

    def train(self) -> None:
        """Run the cells that are not finished, in their order; each is written as soon as it is done."""
        estimate = Estimate()
        for job in self.jobs:
            if job.run is not None:
                estimate.add(job.cell, job.run)
        pending = [job for job in self.jobs if job.run is None]
        for job in pending:
            if not estimate.knows(job.cell):
                try:
                    estimate.probe(job.cell, self.photos(job.cell))
                except (ValueError, TrainingError) as error:
                    self.fail(job, error)
        pending = [job for job in pending if job.failure is None]
        left = duration(estimate.seconds(job.cell for job in pending))
        say(f"{len(self.jobs)} cells, {len(pending)} left, about {left if pending else 'no time'}")
        facts = {"machine": machine_facts(), "versions": version_facts()}
        for k, job in enumerate(pending, 1):
            try:
                job.run, views = run_cell(
                    job.cell, job.key, self.scenes[job.cell.scene], self.photos(job.cell), facts
                )
            except (ValueError, TrainingError) as error:
                self.fail(job, error)
                continue
            self.store.write(job.run, views[: self.pictures] if self.pictured(job.cell) else [])
            estimate.add(job.cell, job.run)
            left = duration(estimate.seconds(j.cell for j in pending[k:]))
            value = job.run["metrics"]["psnr"]
            say(
                f"[{k}/{len(pending)}] {job.cell}: {'no PSNR' if value is None else f'{value:.2f} dB'}, "
                f"{job.run['gaussians']:,} Gaussians, {duration(job.run['wall_seconds'])}; "
                + (f"{len(pending) - k} left, about {left}" if k < len(pending) else "done")
            )
            self.sheets(job.cell.group)

    def photos(self, cell: Cell) -> Scene:
        """What a cell trains on; its group, which comes in a row, shares it."""
        if self._photos is None or self._photos[0] != cell.group:
            sfm = self.store.root / KEPT if self.store.sfm else None
            scene = trained(self.scenes[cell.scene], cell.degradation, cell.seed, sfm)
            self._photos = (cell.group, scene)
        return self._photos[1]

    def fail(self, job: Job, error: Exception) -> None:
        """One cell that cannot be trained does not end the others."""
        job.failure = str(error)
        say(f"{job.cell} failed: {error}")

    def groups(self) -> list[Group]:
        """Those in which every row is finished: only they are compared."""
        found: dict[tuple[str, str, int], dict[str, Run]] = {}
        for job in self.jobs:
            runs = found.setdefault(job.cell.group, {})
            if job.run is not None:
                runs[job.cell.row.label] = job.run
        return [Group(*key, runs) for key, runs in found.items() if len(runs) == len(self.protocol.rows)]

    def pictured(self, cell: Cell) -> bool:
        return cell.seed == self.protocol.seeds[0]

    def sheets(self, group: tuple[str, str, int]) -> None:
        """The picture sheets of a group that is finished, if they are not there yet."""
        jobs = [job for job in self.jobs if job.cell.group == group]
        runs = {job.cell.row.label: job.run for job in jobs if job.run is not None}
        if len(runs) < len(jobs) or not self.pictured(jobs[0].cell):
            return
        scene = self.scenes[group[0]]
        digest = hashlib.sha256(" ".join(job.key for job in jobs).encode()).hexdigest()[:8]
        for number in range(min(self.pictures, len(scene.test))):
            name = f"{scene.name}-{group[1].replace(':', '_')}-s{group[2]}-{number}-{digest}.png"
            path = self.store.root / "pictures" / name
            if not (path.is_file() or write_sheet(path, self.store, scene, runs, number)):
                self.leave_out(f"picture {name}", "the runs did not keep its renders")

    def tables(self) -> None:
        """Everything that the finished runs tell."""
        protocol, report = self.protocol, self.report
        for job in self.jobs:
            if job.run is None:
                self.leave_out(f"run {job.cell}", job.failure or "not finished")
        kinds = [kind for kind in protocol.degradations if kind != NONE]
        maps = []
        for scene in self.scenes.values():
            try:
                maps.append(edge_robustness(scene, kinds, protocol.seeds[0]))
            except ValueError as error:  # a blur too wide for the photos, which fails the runs as well
                self.leave_out(f"edge maps of {scene.name}", str(error))
        report.results |= {"edge_maps": maps, "runs": [job.run for job in self.jobs if job.run is not None]}
        groups, labels = self.groups(), protocol.labels
        if groups:
            self.compare(groups, labels)
        if self.store.sfm and groups:
            report.tables.append(tables.reconstructions(groups))
        if kinds and maps:
            report.tables.append(tables.edge_maps(maps))

    def compare(self, groups: list[Group], labels: list[str]) -> None:
        """Tables and charts of the groups in which every row is finished."""
        protocol, report = self.protocol, self.report
        for group in groups:
            self.sheets((group.scene, group.degradation, group.seed))
        baseline = protocol.baseline if protocol.baseline in labels and len(labels) > 1 else None
        numbers = summary(groups, labels, baseline)
        report.results["summary"] = numbers
        what = self.what(groups)
        report.tables.append(tables.quality(numbers, what))
        if baseline is not None:
            report.tables += [
                tables.gains(numbers, "gain", f"PSNR gain over {baseline}"),
                tables.gains(
                    numbers, "equal_time_gain", f"PSNR gain over {baseline} when the faster of the two ends"
                ),
            ]
            report.figures["gains"] = gain_chart(groups, labels, baseline)
        scenes = dict.fromkeys(group.scene for group in groups)
        for scene in scenes if len(scenes) > 1 else ():
            part = [group for group in groups if group.scene == scene]
            report.tables.append(tables.one_scene(part, labels, self.what(part)))
        runs = [run for group in groups for run in group.runs.values()]
        report.tables.append(tables.training_times(numbers))
        report.tables.append(tables.courses(groups, labels))
        report.tables.append(tables.costs(groups, labels, self.circumstances(runs)))
        report.tables.append(tables.regions(groups, labels))
        guessing = [row.label for row in protocol.rows if any(g.runs[row.label]["formation"] for g in groups)]
        report.tables += [tables.formations(groups, label) for label in guessing]
        report.figures["psnr_vs_time"] = time_chart(groups, labels, what)
        report.figures["regions"] = region_chart(groups, labels)
        for metric, why in sorted({item for run in runs for item in run["reasons"].items()}):
            self.leave_out(metric, why)

    def what(self, groups: Sequence[Group]) -> str:
        """Which runs the tables are of."""
        protocol = self.protocol
        scenes = ", ".join(dict.fromkeys(group.scene for group in groups))
        seeds = ", ".join(str(seed) for seed in dict.fromkeys(group.seed for group in groups))
        held = "VALIDATION views (held-out training photos)" if self.store.validate else "held-out test views"
        return (
            f"{held} of {scenes}; {protocol.iterations:,} iterations, photos at 1/{protocol.downscale:g}, "
            f"seeds {seeds}; "
            + (
                "poses and points from the degraded photos"
                if self.store.sfm
                else "the scenes' own poses and points"
            )
        )

    def circumstances(self, runs: Sequence[Run]) -> str:
        """Machine, threads and commit; a warning where the runs differ in them."""
        seen = {
            "CPU": [" ".join(filter(None, map(run["machine"].get, ("cpu", "simd")))) for run in runs],
            "threads": [run["threads"] for run in runs],
            "commit": [run["versions"]["git_commit"] for run in runs],
        }
        kinds = {name: sorted({str(value) for value in values}) for name, values in seen.items()}
        self.report.settings |= kinds
        mixed = [name for name, values in kinds.items() if len(values) > 1]
        text = "; ".join(f"{name} {', '.join(values)}" for name, values in kinds.items())
        return text + (f"; MIXED: {', '.join(mixed)}" if mixed else "")

    def leave_out(self, what: str, why: str) -> None:
        entry = {"what": what, "why": why}
        if entry not in self.report.left_out:
            self.report.left_out.append(entry)


def say(text: str) -> None:
    print(f"quality: {text}", file=sys.stderr, flush=True)


def run(args: argparse.Namespace) -> Report:
    """Run and compare what was asked for."""
    if args.pictures < 0:
        raise ValueError(f"pictures is {args.pictures}, wanted at least 0")
    name = SMOKE if args.quick else args.protocol
    protocol = narrowed(
        PROTOCOLS[name], args.degradations, args.methods, args.seeds, args.iterations, args.downscale
    )
    sources = args.scenes[:1] if protocol.one_scene else args.scenes
    scenes = load_scenes(sources, protocol.downscale, protocol.embedded, args.out / "scenes", args.validate)
    settings = {"protocol": name, **asdict(protocol), "scenes": [s.name for s in scenes]}
    part = name + ("_sfm" if args.sfm else "") + ("_validation" if args.validate else "")
    report = Report(settings | {"validation": args.validate, "sfm": args.sfm}, part)
    store = RunStore(args.out, args.validate, args.sfm)
    for path in args.known or ():
        store.take(path)
    quality = Quality(protocol, scenes, store, args.pictures, report)
    if not args.finished:
        quality.train()
    quality.tables()
    write_text(args.out / f"quality_{part}.md", "\n\n".join(report.tables) + "\n")
    return report


def add_options(parser: argparse.ArgumentParser) -> None:
    add: Any = parser.add_argument
    listed = "; ".join(f"{name}: {protocol.help}" for name, protocol in PROTOCOLS.items())
    add("--protocol", choices=PROTOCOLS, default="standard", metavar="NAME", help=f"{listed} (%(default)s)")
    add(
        "--scenes", nargs="+", type=Path, default=[EMBEDDED], metavar="DIR",
        help=f"scene folders; {EMBEDDED} is the built-in scene (%(default)s)",
    )  # fmt: skip
    add("--degradations", nargs="+", metavar="KIND", help="instead of the protocol's")
    add("--methods", nargs="+", metavar="ROW", help="only these rows of the protocol")
    add("--seeds", nargs="+", type=int, metavar="S", help="instead of the protocol's")
    add("--iterations", type=int, metavar="N", help="instead of the protocol's")
    add("--downscale", type=float, metavar="F", help="instead of the protocol's")
    add("--validate", action="store_true", help="for tuning: judge on training photos, leave test views out")
    add("--sfm", action="store_true", help="poses and points from the degraded photos, the same for all rows")
    add("--pictures", type=int, default=1, metavar="N", help="sheets per scene and degradation (%(default)s)")
    add(
        "--known", nargs="+", type=Path, metavar="JSON",
        help="results of this benchmark from elsewhere: their runs count as finished",
    )  # fmt: skip
    add("--finished", action="store_true", help="train nothing: tables of the runs that are finished")


BENCHMARK = Benchmark("error of each method over scenes, degradations and seeds", add_options, run)
