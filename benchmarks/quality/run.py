"""The benchmark `quality`: how near the truth each method comes, over scenes, degradations and seeds."""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

from pandas import DataFrame

from benchmarks.output import Benchmark, Report
from benchmarks.protocol import read_protocols
from benchmarks.quality import tables
from benchmarks.quality.cell import edge_robustness, run_cell, write_sheet
from benchmarks.quality.rivals import RivalRow
from benchmarks.study import Cell, Study, begin
from hqgs.base.files import write_text
from hqgs.photos.formula import NONE
from hqgs.scene.scene import Scene

PROTOCOLS = read_protocols(Path(__file__).parent / "protocols.toml", RivalRow)


class Quality:
    """A study and what its tables need to know of it."""

    def __init__(self, study: Study, part: str = "") -> None:
        self.study, self.args, self.protocol = study, study.args, study.protocol
        study.train(self.measure)
        self.report = study.report(part)

    def measure(self, cell: Cell, photos: Scene) -> dict[str, Any]:
        renders = self.args.pictures if cell.seed == self.protocol.seeds[0] else 0
        return run_cell(cell, photos, self.study, renders, self.args.sfm or self.args.fit_cameras)

    def compared(self) -> DataFrame:
        """The runs that see the same photos where every row is finished: only they are compared."""
        runs = DataFrame(self.study.results(), columns=None if self.study.runs else tables.GROUP)
        whole = runs.groupby(tables.GROUP)["seed"].transform("size") == len(self.protocol.rows)
        return runs.loc[whole]

    def sheets(self, group: DataFrame) -> None:
        """The picture sheets of a group, if they are not there yet."""
        (name, kind, seed), runs = group[tables.GROUP].iloc[0], group.set_index("row").to_dict("index")
        scene = next(scene for scene in self.study.scenes if scene.name == name)
        digest = hashlib.sha256(" ".join(group["key"]).encode()).hexdigest()[:8]
        for number in range(min(self.args.pictures, len(scene.test))):
            name = f"{scene.name}-{kind.replace(':', '_')}-s{seed}-{number}-{digest}.png"
            path = self.args.out / "pictures" / name
            if not (path.is_file() or write_sheet(path, self.study.store, scene, runs, number)):
                self.report.leave_out(f"picture {name}", "the runs did not keep its renders")

    def tables(self) -> None:
        """Everything that the finished runs tell."""
        report = self.report
        kinds = [kind for kind in self.protocol.degradations if kind != NONE]
        maps = []
        for scene in self.study.scenes:
            try:
                maps.append(edge_robustness(scene, kinds, self.protocol.seeds[0]))
            except ValueError as error:  # a blur too wide for the photos, which fails the runs as well
                report.leave_out(f"edge maps of {scene.name}", str(error))
        report.results |= {"edge_maps": maps, "runs": self.study.results()}
        if len(runs := self.compared()):
            self.compare(runs)
        if kinds and maps:
            report.tables.append(tables.edge_maps(maps))

    def compare(self, runs: DataFrame) -> None:
        """Tables and charts of the groups in which every row is finished."""
        report, labels = self.report, self.protocol.labels
        for _, group in runs.loc[runs["seed"] == self.protocol.seeds[0]].groupby(tables.GROUP, sort=False):
            self.sheets(group)
        baseline = self.protocol.baseline if self.protocol.baseline in labels and len(labels) > 1 else None
        frame = tables.frame_of(runs, baseline)
        what = self.what(frame)
        report.tables.append(tables.metrics(frame, what))
        if "fitted" in frame and frame["fitted"].notna().all():
            report.tables.append(tables.fitted(frame, what))
        if baseline is not None:
            over = f"PSNR gain over {baseline}"
            for name, when in zip(tables.GAINS, ("", " when the faster of the two ends"), strict=True):
                report.tables.append(tables.gains(frame, name, f"{over}{when}", baseline))
            report.figures["gains"] = tables.gain_chart(frame, baseline)
        parts = frame.groupby("scene", sort=False)
        for _, part in parts if len(parts) > 1 else ():
            report.tables.append(tables.metrics(part, self.what(part), ("psnr", "ssim")))
        report.tables += [tables.best_and_last(frame), tables.training_times(frame), tables.courses(frame)]
        report.tables += [tables.costs(frame, self.circumstances()), tables.regions(frame)]
        guessing = frame.loc[frame["formation"].notna(), "row"].unique()
        report.tables += [tables.formations(frame, label) for label in labels if label in guessing]
        if self.args.sfm:
            report.tables.append(tables.reconstructions(frame))
        for metric, why in sorted({item for reasons in frame["reasons"] for item in reasons.items()}):
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
        mixed = [name for name, values in kinds.items() if len(values) > 1]
        text = "; ".join(f"{name} {', '.join(values)}" for name, values in kinds.items())
        return text + (f"; MIXED: {', '.join(mixed)}" if mixed else "")


def run(args: argparse.Namespace) -> Report:
    """Run and compare what was asked for."""
    if args.pictures < 0:
        raise ValueError(f"pictures is {args.pictures}, wanted at least 0")
    name = "quick" if args.quick else args.protocol
    study = begin(args, PROTOCOLS, labelled=False)
    quality = Quality(study, "_".join([name, *reversed(study.tags)]))
    quality.report.settings["protocol"] = name
    quality.tables()
    write_text(args.out / f"quality_{quality.report.part}.md", "\n\n".join(quality.report.tables) + "\n")
    return quality.report


LISTED = "; ".join(f"{name}: {protocol.help}" for name, protocol in PROTOCOLS.items())
SFM = "poses and points from the degraded photos, the same for all rows"
FIT = "measure a second time with each held-out camera fitted to the trained scene, as --sfm does"
OPTIONS: dict[str, dict[str, Any]] = {
    "--protocol": {"choices": PROTOCOLS, "default": "standard", "metavar": "NAME", "help": LISTED},
    "--degradations": {"nargs": "+", "metavar": "KIND", "help": "instead of the protocol's"},
    "--validate": {"action": "store_true", "help": "for tuning: judge on training photos, not on test views"},
    "--sfm": {"action": "store_true", "help": SFM},
    "--fit-cameras": {"action": "store_true", "help": FIT},
    "--pictures": {"type": int, "default": 1, "metavar": "N", "help": "sheets per scene and degradation"},
}
BENCHMARK = Benchmark("error of each method over scenes, degradations and seeds", run, PROTOCOLS, OPTIONS)
