"""The benchmark `export`: the size of a scene file against what it costs in held-out error."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import hqgs
from benchmarks.command import Benchmark
from benchmarks.pages.sections import files, files_head
from benchmarks.protocol import read_protocols, read_toml
from benchmarks.rows import Table, facts
from benchmarks.study import chosen, sources
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
    """A line for each of VARIANTS, of the file as it is read back."""
    original = held_out_renders(scene, gaussians)
    before, camera = held_out_psnr(scene, original), scene.test[0].camera
    rows: list[dict[str, Any]] = []
    for name, options in VARIANTS.items():
        print(f"export: {name}", file=sys.stderr, flush=True)
        written = export(gaussians, folder / f"scene.{options.format}", options)
        renders = held_out_renders(scene, Gaussians.load(written.path))
        after = held_out_psnr(scene, renders)
        a, b = (np.concatenate([view.render.clip(0, 1) for view in views]) for views in (renders, original))
        row = {"scene": scene.name, "file": name, "width": camera.width, "height": camera.height}
        row |= {"gaussians": written.gaussians, "sh_degree": written.sh_degree, "bytes": written.bytes}
        row |= {"psnr": after, "cost_db": before - after, "psnr_to_original": psnr(a, b)}
        rows.append(row | {"largest_change": float(np.abs(a - b).max())})
    more = facts() | {"ply_bytes": rows[0]["bytes"] + NORMALS * len(gaussians)}
    return [row | more for row in rows]


def run(args: argparse.Namespace) -> list[str]:
    """Train, and write the Gaussians in every way."""
    if len(args.scenes) > 1 or len(args.seeds or ()) > 1:
        raise ValueError("one scene and one seed are written")
    protocol, (scene,) = chosen(args, PROTOCOLS)
    seed = protocol.seeds[0]
    parts = (scene.name, f"x{protocol.downscale:g}", f"s{seed}", str(protocol.iterations), sources())
    folder, config = args.out / "runs" / "-".join(parts), protocol.train_config(protocol.rows[0], seed)
    if not (args.finished or hqgs.train(scene, out=folder, config=config, resume=True).finished):
        raise KeyboardInterrupt  # the next call goes on with it
    gaussians = Gaussians.load(folder)
    with tempfile.TemporaryDirectory(dir=args.out) as name:
        rows = measure(scene, gaussians, Path(name))
    table = Table(args.out / "export.csv")
    runs = table.frame(table.put(rows))
    return [files_head(runs), files(runs)]


BENCHMARK = Benchmark("the size of a scene file against its cost in held-out error", run, PROTOCOLS)
