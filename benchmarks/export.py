"""The benchmark `export`: the size of a scene file against what it costs in held-out error."""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import hqgs
from benchmarks.output import GREY, LEGEND, Benchmark, Report, color, panels, table, title, unbeaten
from benchmarks.protocol import read_protocols, read_toml
from benchmarks.study import begin
from hqgs.base.files import PLY
from hqgs.base.typed import build
from hqgs.evaluation.held_out import held_out_psnr, held_out_renders
from hqgs.evaluation.metrics import psnr
from hqgs.model.gaussians import Gaussians
from hqgs.scene.scene import Scene
from hqgs.show.export import export
from hqgs.show.export_options import ExportOptions

NORMALS = 3 * 4  # bytes a Gaussian: what 3DGS writes and `Gaussians.save` does not
FILE = Path(__file__).with_suffix(".toml")
PROTOCOLS, DATA = read_protocols(FILE), read_toml(FILE)
VARIANTS = {
    name: build(ExportOptions, table, f"{FILE.name}, file {name!r}") for name, table in DATA["files"].items()
}


def measure(scene: Scene, gaussians: Gaussians, folder: Path) -> list[dict[str, Any]]:
    """One row for each of VARIANTS, of the file as it is read back."""
    original = held_out_renders(scene, gaussians)
    before = held_out_psnr(scene, original)
    rows = []
    for name, options in VARIANTS.items():
        print(f"export: {name}", file=sys.stderr, flush=True)
        written = export(gaussians, folder / f"scene.{options.format}", options)
        renders = held_out_renders(scene, Gaussians.load(written.path))
        after = held_out_psnr(scene, renders)
        a, b = (np.concatenate([view.render.clip(0, 1) for view in views]) for views in (renders, original))
        row = {"name": name, "options": asdict(options), "psnr": after, "cost_db": before - after}
        row |= {"psnr_to_original": psnr(a, b), "largest_change": float(np.abs(a - b).max())}
        rows.append(asdict(written) | row)
        del rows[-1]["path"]
    best = unbeaten([(row["bytes"], -row["psnr"]) for row in rows])
    return [row | {"pareto": k in best} for k, row in enumerate(rows)]


def files_table(result: dict[str, Any]) -> str:
    lines = [
        row
        | {"mb": row["bytes"] / 1e6, "share": 100 * row["bytes"] / result["ply_of_3dgs_bytes"]}
        | {"change": 0.0 - row["cost_db"], "levels": 255 * row["largest_change"]}
        | ({"psnr_to_original": "same"} if row["psnr_to_original"] is None else {})
        for row in result["files"]
    ]
    title = (
        f"{result['scene']}, {result['width']} x {result['height']}: {result['gaussians']:,} Gaussians of "
        f"degree {result['sh_degree']}, {result['psnr']:.3f} dB; MB = 10^6 bytes"
    )
    return table(title, lines, DATA["columns"])


def chart(result: dict[str, Any]) -> Figure:
    """Held-out PSNR against MB; the line joins the files that no other beats in both."""
    figure, (axes,) = panels(8, 5)
    rows = result["files"]
    for k, (label, start) in enumerate(DATA["chart"].items()):
        points = [(r["bytes"] / 1e6, r["psnr"]) for r in rows if r["name"].startswith(start)]
        axes.plot(*zip(*points, strict=True), ls="", marker="so^D"[k], color=color(k), label=label, ms=6)
    front = sorted((r["bytes"] / 1e6, r["psnr"]) for r in rows if r["pareto"])
    axes.plot(*zip(*front, strict=True), color="black", lw=1.0, zorder=1, label="Pareto front")
    axes.axhline(result["psnr"], color=GREY, lw=0.8, ls=":", label="the Gaussians as trained")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.set(xlabel="file (MB)", ylabel="held-out PSNR (dB)")
    title(axes, f"{result['scene']}: size against error")
    axes.grid(color="#dddddd", linewidth=0.7, which="both")
    axes.legend(**LEGEND)
    return figure


def run(args: argparse.Namespace) -> Report:
    """Train, or read a run, and write its Gaussians in every way."""
    if len(args.scenes) > 1 or len(args.seeds or ()) > 1:
        raise ValueError("one scene and one seed are written")
    study = begin(args, PROTOCOLS, labelled=False)
    (cell,) = study.cells
    scene, folder, settings = cell.scene, args.run_folder, {"downscale": study.protocol.downscale}
    if folder is None:
        folder, settings = study.beside(cell, PLY).parent, study.report().settings
        if not (args.finished or hqgs.train(scene, out=folder, config=cell.config, resume=True).finished):
            raise KeyboardInterrupt  # the next call goes on with it
    gaussians = Gaussians.load(folder)
    with tempfile.TemporaryDirectory(dir=args.out) as name:
        files = measure(scene, gaussians, Path(name))
    result = {
        "scene": scene.name,
        "width": scene.test[0].camera.width,
        "height": scene.test[0].camera.height,
        "gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "psnr": files[0]["psnr"] + files[0]["cost_db"],
        "ply_of_3dgs_bytes": files[0]["bytes"] + NORMALS * len(gaussians),
        "files": files,
    }
    return Report(settings, results=result, tables=[files_table(result)], figures={"size": chart(result)})


HELP = "write the Gaussians of this run of the scene instead"
OPTIONS = {"--run-folder": {"type": Path, "metavar": "DIR", "help": HELP}}
BENCHMARK = Benchmark("the size of a scene file against its cost in held-out error", run, PROTOCOLS, OPTIONS)
