"""The benchmark `quality`: how near the truth each method comes, over scenes, degradations and seeds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks.command import Benchmark
from benchmarks.pages.figures import crossed, gains
from benchmarks.protocol import read_protocols
from benchmarks.quality.cell import reconstruction, run_cell, write_sheet
from benchmarks.rows import Table, facts
from benchmarks.study import Cell, Study, begin
from hqgs.scene.scene import Scene

PROTOCOLS = read_protocols(Path(__file__).parent / "protocols.toml")
ALSO = {"ssim": ("SSIM", ".3f")}
POSES = "poses.csv"  # what `--sfm` found


class Quality:
    """A study, the renders that it keeps and what it says of poses."""

    def __init__(self, study: Study) -> None:
        self.study, self.args, self.protocol = study, study.args, study.protocol

    def measure(self, cell: Cell, photos: Scene) -> dict[str, Any]:
        keeps = cell.seed == self.protocol.seeds[0]
        pictures = [self.render(cell, number) for number in range(self.args.pictures if keeps else 0)]
        fit = self.args.sfm or self.args.fit_cameras
        run = run_cell(cell, photos, pictures, fit)
        self.note(cell, photos)
        return run

    def note(self, cell: Cell, photos: Scene) -> None:
        """A line of what COLMAP found in the cell's photos; seconds of a model that was kept stay."""
        if photos.sfm is None:
            return
        table = Table(self.args.out / POSES)
        line = {name: cell.key[name] for name in ("scene", "degradation", "seed", "downscale")}
        known = (table.find(line) or {}).get("search_cpu_s")
        seconds = {"search_cpu_s": self.study.search_cpu_s or known}
        table.put([line | reconstruction(photos.sfm) | seconds | facts()])

    def render(self, cell: Cell, number: int) -> Path:
        return self.study.beside(cell, f"{number}.png")

    def sheets(self) -> list[str]:
        """Write the picture sheets of the first seed where every row is finished; which could not be."""
        groups: dict[tuple[str, str, int], list[Cell]] = {}
        for cell in self.study.cells:
            if cell.seed == self.protocol.seeds[0]:
                groups.setdefault(cell.group, []).append(cell)
        lost = []
        for (name, kind, seed), cells in groups.items():
            if any(cell not in self.study.runs for cell in cells):
                continue
            scene, folder = cells[0].scene, self.args.out / "pictures"
            for number in range(min(self.args.pictures, len(scene.test))):
                path = folder / f"{name}-{kind.replace(':', '_')}-s{seed}-{number}.png"
                renders = {cell.row.label: self.render(cell, number) for cell in cells}
                if not write_sheet(path, scene, kind, seed, renders, number):
                    lost.append(f"left out: picture {path.name}: the runs did not keep its renders")
        return lost

    def tables(self) -> list[str]:
        """PSNR of the finished runs, and gains over the baseline."""
        runs, protocol = self.study.frame(), self.protocol
        if not len(runs):
            return []
        seeds = ", ".join(map(str, protocol.seeds))
        held = "VALIDATION views (held-out training photos)" if self.args.validate else "held-out views"
        what = f"PSNR (dB) of {held}: {protocol.iterations:,} iterations, photos at 1/{protocol.downscale:g}"
        across = "scene" if len(self.study.scenes) > len(protocol.degradations) else "degradation"
        found = [f"{what}, seeds {seeds}", crossed(runs, also=ALSO, across=across)]
        if "psnr_fitted" in runs:
            found += ["The same with held-out cameras fitted to the scene", crossed(runs, "psnr_fitted")]
        others = [label for label in protocol.labels if label != protocol.baseline]
        if protocol.baseline in set(runs["row"]) and others:
            found.append(
                gains(
                    runs,
                    others,
                    protocol.baseline,
                    across=across,
                    corner=f"gain over {protocol.baseline} (dB)",
                )
            )
        return found


def run(args: argparse.Namespace) -> list[str]:
    """Run and compare what was asked for."""
    if args.pictures < 0:
        raise ValueError(f"pictures is {args.pictures}, wanted at least 0")
    quality = Quality(begin(args, PROTOCOLS))
    quality.study.train(quality.measure)
    return [*quality.tables(), *quality.sheets(), *quality.study.missing()]


FIT = "measure a second time with each held-out camera fitted to the trained scene, as --sfm does"
SFM = "poses and points from the degraded photos, the same for all rows"
PICTURES = "sheets per scene and degradation"
OPTIONS: dict[str, dict[str, Any]] = {
    "--degradations": {"nargs": "+", "metavar": "KIND", "help": "instead of the protocol's"},
    "--validate": {"action": "store_true", "help": "for tuning: judge on training photos, not on test views"},
    "--sfm": {"action": "store_true", "help": SFM},
    "--fit-cameras": {"action": "store_true", "help": FIT},
    "--pictures": {"type": int, "default": 1, "metavar": "N", "help": PICTURES},
}
BENCHMARK = Benchmark("error of each method over scenes, degradations and seeds", run, PROTOCOLS, OPTIONS)
