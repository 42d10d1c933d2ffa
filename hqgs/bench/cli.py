"""`hqgs bench NAME`: measure, print Markdown tables, write one JSON file and charts."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import hqgs
from hqgs.bench import accuracy, quality, speed, stability, training
from hqgs.bench.output import Benchmark, command_line, write_results

BENCHMARKS: dict[str, Benchmark] = {
    "accuracy": accuracy.BENCHMARK,
    "quality": quality.BENCHMARK,
    "speed": speed.BENCHMARK,
    "stability": stability.BENCHMARK,
    "training": training.BENCHMARK,
}


def add_parser(commands: argparse._SubParsersAction[Any]) -> None:
    """Add `bench` and its benchmarks to the subcommands of a parser."""
    bench = commands.add_parser("bench", help="measure what hqgs needs and how right it is")
    bench.set_defaults(run=main)
    names = bench.add_subparsers(required=True, metavar="NAME", dest="benchmark")
    for name, benchmark in BENCHMARKS.items():
        parser = names.add_parser(name, help=benchmark.help, description=benchmark.help)
        out = Path("out", "bench")
        parser.add_argument(
            "--out", type=Path, default=out, metavar="DIR", help=f"for {name}.json (%(default)s)"
        )
        parser.add_argument("--threads", type=int, metavar="T", help="(all cores)")
        parser.add_argument("--quick", action="store_true", help="tiny sizes, seconds: only a test")
        benchmark.add_options(parser)


def main(args: argparse.Namespace) -> int:
    """Run the benchmark that `args` names; return the exit code (0 done, 1 failed, 2 bad input)."""
    name = args.benchmark
    try:
        args.out.mkdir(parents=True, exist_ok=True)  # an unusable place shows before the work
        if args.threads is not None:
            hqgs.set_num_threads(args.threads)
        report = BENCHMARKS[name].run(args)
    except (ValueError, FileNotFoundError, FileExistsError, NotADirectoryError, PermissionError) as error:
        print(f"hqgs: {error}", file=sys.stderr)
        return 2
    try:
        files = write_results(args.out, name, command_line(args), report)
    except OSError as error:
        print(f"hqgs: {args.out}: {error}", file=sys.stderr)
        return 1
    for table in report.tables:
        print(table, end="\n\n")
    for entry in report.left_out:
        print(f"left out: {entry['what']}: {entry['why']}")
    print(f"written: {', '.join(map(str, files))}")
    return 0
