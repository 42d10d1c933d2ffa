"""The benchmark `stages`: what people wait for from photos to a scene, beside another checkout of hqgs.

`hqgs train SCENE --preset quick` of both in alternation, whole processes. A checkout needs its own built
extension; a round that is finished is not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd

import hqgs
from benchmarks.command import Benchmark
from benchmarks.pages.figures import number, pick, table
from benchmarks.rows import Table, facts, pairs_of
from hqgs.base.files import REPORT

TREES = {"here": Path(hqgs.__file__).parents[1]}
UNITS = {"s": 1, "min": 60, "h": 3600}
STAGES = "loading", "preparing", "training", "report"
NUMBERS = ["seconds", "cpu_seconds", "psnr", "ssim"]


def seconds_of(text: str) -> float:
    """Of `6 min 3 s`."""
    return sum(float(count) * UNITS[unit] for count, unit in re.findall(r"([\d.]+) (s|min|h)\b", text))


def parts_of(printed: str) -> dict[str, float]:
    """Seconds of each stage, from the last line of `hqgs train`; those of COLMAP are part of loading."""
    line = next(line for line in printed.splitlines() if line.startswith("time: "))
    return {
        name: seconds_of(text) for name, text in re.findall(r"([A-Za-z]+) ((?:\d+ (?:h|min|s) ?)+)", line)
    }


def measure(tree: Path, scene: str, options: list[str], folder: Path) -> dict[str, Any]:
    """One run of a checkout in a process of its own; RuntimeError where it fails."""
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "hqgs", "train", scene, *options, "--out", str(folder)]
    told = {"env": os.environ | {"PYTHONPATH": str(tree)}, "cwd": folder.parent}
    before, start = os.times(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, **told)
    seconds, after = time.perf_counter() - start, os.times()
    if done.returncode:
        raise RuntimeError(f"{tree}: {' '.join(command)} failed: {done.stderr[-2000:]}")
    metrics = json.loads((folder / REPORT).read_text(encoding="utf-8"))["metrics"]["mean"]
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    row = {"seconds": seconds, "cpu_seconds": cpu, "psnr": metrics["psnr"], "ssim": metrics["ssim"]}
    return row | {"stages": parts_of(done.stdout + done.stderr)}


def whole_table(runs: pd.DataFrame) -> str:
    """A line for each scene: this checkout's medians, and their ratios to the other's in the same rounds."""
    body, both = list[list[str]](), "than" in set(runs["row"])
    for scene in dict.fromkeys(runs["scene"]):
        mine = pick(runs, scene=scene)
        if len(set(mine["row"])) <= both:
            continue
        cells = [str(scene), number(pick(mine, row="here")["seconds"].median(), ".0f")]
        if both:
            pairs = {value: mine.pivot(index="round", columns="row", values=value) for value in NUMBERS}
            cells += [number((pairs[v]["here"] / pairs[v]["than"]).median(), ".2f") for v in NUMBERS[:2]]
            gains = [(pairs[v]["here"] - pairs[v]["than"]).median() for v in NUMBERS[2:]]
            cells += [number(gains[0], "+.2f"), number(gains[1], "+.3f"), _stages(mine, "than")]
        body.append([*cells, _stages(mine, "here")])
    heads = ["of the time before", "of the CPU time", "PSNR (dB)", "SSIM", f"before: {'/'.join(STAGES)}"]
    return table(["capture", "s", *(heads if both else []), "/".join(STAGES)], body)


def _stages(runs: pd.DataFrame, row: str) -> str:
    """Seconds of the last run: 9/4/16/1."""
    seconds = dict(pairs_of(str(pick(runs, row=row)["stages"].iloc[-1])))
    return "/".join(f"{seconds.get(stage, 0):.0f}" for stage in STAGES)


def run(args: argparse.Namespace) -> list[str]:
    """Train what is not finished, a line a run."""
    kept = Table(args.out / "stages.csv")
    trees = TREES | ({} if args.than is None else {"than": args.than.resolve()})
    options = ["--preset", args.preset, *(["--iterations", "20"] if args.quick else [])]
    scenes = {Path(one).name: str(Path(one).resolve()) if Path(one).is_dir() else one for one in args.scenes}
    for turn in range(args.rounds):
        for name, scene in scenes.items():
            for row, tree in trees.items():
                key = {"scene": name, "preset": args.preset, "row": row, "round": turn}
                if kept.find(key) is None:
                    line = kept.put([key | measure(tree, scene, options, args.out / "run") | facts()])[0]
                    print(f"stages: {name}, {row}: {line['seconds']} s", file=sys.stderr, flush=True)
    lines = [line for line in kept.rows() if line["scene"] in scenes and line["preset"] == args.preset]
    runs = pd.DataFrame(lines)
    return [whole_table(runs.assign(**{name: pd.to_numeric(runs[name]) for name in NUMBERS}))]


OPTIONS: dict[str, dict[str, Any]] = {
    "--scenes": {
        "nargs": "+",
        "default": ["embedded"],
        "metavar": "SCENE",
        "help": "folders of photos (%(default)s)",
    },
    "--than": {"type": Path, "metavar": "CHECKOUT", "help": "another checkout, built, run in alternation"},
    "--preset": {"default": "quick", "metavar": "NAME", "help": "(%(default)s)"},
    "--rounds": {"type": int, "default": 1, "metavar": "N", "help": "(%(default)s)"},
}
BENCHMARK = Benchmark("seconds of each stage from photos to a scene", run, options=OPTIONS)
