"""The benchmark `export`: the size of a scene file against what it costs in held-out error."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.output import Benchmark, Report
from hqgs.base.text import markdown_table
from hqgs.evaluation.held_out import held_out_psnr, held_out_renders
from hqgs.evaluation.metrics import psnr
from hqgs.export.export import READERS, ExportOptions, export, read_scene_file
from hqgs.model.gaussians import Gaussians
from hqgs.pipeline import train
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.builtin.scene import HEIGHT, WIDTH
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig

EMBEDDED = "embedded"
NORMALS = 3 * 4  # bytes a Gaussian: what 3DGS writes and `hqgs.ply` does not
TOLERANCES = (0.0, 0.004, 0.016)
BITS = ((8, 8), (5, 4))  # of the harmonics; the second is what Niantic's writer takes


@dataclass(frozen=True)
class ExportConfig:
    """The run whose Gaussians are written."""

    iterations: int = 3_000
    downscale: float = 2.0
    seed: int = 0


QUICK = ExportConfig(iterations=20, downscale=12.0)


def variants() -> dict[str, ExportOptions]:
    """What is written, by a name for the table. The first is the PLY file with everything."""
    default = ExportOptions("spz")
    files = {f"ply, degree {d}": ExportOptions("ply", d, 0.0) for d in (3, 2, 1, 0)}
    files["ply, default"] = ExportOptions("ply")
    for bits in BITS:
        for tolerance in TOLERANCES:
            name = f"spz, {bits[0]} and {bits[1]} bits, tolerance {tolerance:g}"
            files[name] = replace(default, sh_bits=bits, band_tolerance=tolerance)
    files |= {f"spz, degree {d}": replace(default, sh_degree=d) for d in (2, 1, 0)}
    return files


def measure(scene: Scene, gaussians: Gaussians, folder: Path) -> list[dict[str, Any]]:
    """One row for each variant, of the file as it is read back."""
    original = held_out_renders(scene, gaussians)
    before = held_out_psnr(scene, original)
    rows = []
    for name, options in variants().items():
        print(f"bench export: {name}", file=sys.stderr, flush=True)
        written = export(gaussians, folder / f"scene.{options.format}", options)
        renders = held_out_renders(scene, READERS[options.format](written.path))
        after = held_out_psnr(scene, renders)
        pairs = [(a.clip(0, 1), b.clip(0, 1)) for a, b in zip(renders, original, strict=True)]
        rows.append(
            {
                "name": name,
                "options": asdict(options),
                "bytes": written.bytes,
                "gaussians": written.gaussians,
                "sh_degree": written.sh_degree,
                "psnr": after,
                "cost_db": before - after,
                "psnr_to_original": psnr(*(np.concatenate([p[k] for p in pairs]) for k in (0, 1))),
                "largest_change": max(float(np.abs(a - b).max()) for a, b in pairs),
                "left_out": [asdict(entry) for entry in written.left_out],
                "clipped": written.clipped,
            }
        )
    for row, better in zip(rows, pareto(rows), strict=True):
        row["pareto"] = better
    return rows


def pareto(rows: Sequence[dict[str, Any]]) -> list[bool]:
    """Of each row, whether no other is smaller or as small and better, or better and as small."""
    return [
        not any(
            o["bytes"] <= r["bytes"]
            and o["psnr"] >= r["psnr"]
            and (o["bytes"] < r["bytes"] or o["psnr"] > r["psnr"])
            for o in rows
        )
        for r in rows
    ]


def table(result: dict[str, Any]) -> str:
    rows = result["files"]
    body = [
        [
            row["name"],
            str(row["sh_degree"]),
            f"{row['gaussians']:,}",
            f"{row['bytes'] / 1e6:.3f}",
            f"{100 * row['bytes'] / result['ply_of_3dgs_bytes']:.1f}",
            f"{row['psnr']:.3f}",
            f"{0.0 - row['cost_db']:+.3f}",
            "same" if row["psnr_to_original"] is None else f"{row['psnr_to_original']:.1f}",
            f"{255 * row['largest_change']:.1f}",
            "yes" if row["pareto"] else "",
        ]
        for row in rows
    ]
    head = [
        "file", "degree", "Gaussians", "MB", "of 3DGS's PLY (%)", "held-out PSNR (dB)", "change",
        "PSNR to the original's renders", "largest change (1/255)", "Pareto",
    ]  # fmt: skip
    title = (
        f"{result['scene']}, {result['width']} x {result['height']}: {result['gaussians']:,} Gaussians of "
        f"degree {result['sh_degree']}, {result['psnr']:.3f} dB; MB = 10^6 bytes"
    )
    return markdown_table(title, head, body)


def chart(result: dict[str, Any]) -> Figure:
    """Held-out PSNR against MB; the line joins the files that no other beats in both."""
    figure = Figure(figsize=(8, 5), dpi=150, layout="constrained")
    axes = figure.subplots()
    rows = result["files"]
    groups = {"ply": ("PLY, float32", "s", "#1f6fb2")}
    for bits, marker, color in zip(BITS, ("o", "^"), ("#2a8c4a", "#c2571a"), strict=True):
        groups[f"spz, {bits[0]} and"] = (f"SPZ, {bits[0]} and {bits[1]} bits of harmonics", marker, color)
    groups["spz, degree"] = ("SPZ, fewer bands", "D", "#777777")
    for start, (label, marker, color) in groups.items():
        points = [(r["bytes"] / 1e6, r["psnr"]) for r in rows if r["name"].startswith(start)]
        axes.plot(*zip(*points, strict=True), ls="", marker=marker, color=color, label=label, ms=6)
    front = sorted((r["bytes"] / 1e6, r["psnr"]) for r in rows if r["pareto"])
    axes.plot(*zip(*front, strict=True), color="black", lw=1.0, zorder=1, label="Pareto front")
    axes.axhline(result["psnr"], color="#999999", lw=0.8, ls=":", label="the Gaussians as trained")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.set(xlabel="file (MB)", ylabel="held-out PSNR (dB)", title=f"{result['scene']}: size against error")
    axes.grid(color="#dddddd", linewidth=0.7, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return figure


def run(args: argparse.Namespace) -> Report:
    """Train, or read a run, and write its Gaussians in every way."""
    config = QUICK if args.quick else ExportConfig()
    changes = {n: v for n in ("iterations", "downscale", "seed") if (v := getattr(args, n)) is not None}
    config = replace(config, **changes)
    if not config.downscale >= 1:
        raise ValueError(f"downscale must be at least 1, got {config.downscale}")
    if (args.run_folder is None) != (args.scene is None):
        raise ValueError("--run-folder and --scene go together: a run, and the scene it was trained on")
    settings = asdict(config)
    if args.run_folder is None:
        width, height = (max(1, round(side / config.downscale)) for side in (WIDTH, HEIGHT))
        scene = embedded_scene(args.out / "scene", width, height)
        train_config = TrainConfig(iterations=config.iterations, seed=config.seed).scaled()
        folder = args.out / "export"
        train(scene, train_config, folder, resume=True, progress=False)
    else:
        scene, folder = load_scene(args.scene, config.downscale), args.run_folder
        settings = {"downscale": config.downscale}
    gaussians = read_scene_file(folder)
    camera = scene.test[0].camera if scene.test else scene.train[0].camera
    with tempfile.TemporaryDirectory(dir=args.out) as name:
        files = measure(scene, gaussians, Path(name))
    result = {
        "scene": scene.name,
        "width": camera.width,
        "height": camera.height,
        "gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "psnr": files[0]["psnr"] + files[0]["cost_db"],
        "ply_of_3dgs_bytes": files[0]["bytes"] + NORMALS * len(gaussians),
        "files": files,
    }
    return Report(settings, results=result, tables=[table(result)], figures={"size": chart(result)})


def add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--iterations", type=int, metavar="N", help="of 3dgs on the built-in scene (3000, with --quick 20)")
    add("--downscale", type=float, metavar="F", help="divide the photos' sides by F (2, with --quick 12)")
    add("--seed", type=int, metavar="S", help="of the training (0)")
    add("--run-folder", type=Path, metavar="DIR", help="write the Gaussians of this run instead")
    add("--scene", type=Path, metavar="SCENE", help="that the run was trained on")


BENCHMARK = Benchmark("the size of a scene file against its cost in held-out error", add_options, run)
