"""`hqgs bench NAME`: measure, print Markdown tables, write one JSON file and charts."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import hqgs
from hqgs.bench import accuracy, endurance, export, frugality, quality, speed, stability, training
from hqgs.bench.output import Benchmark, command_line, write_results
from hqgs.exits import BAD_INPUT, fail
from hqgs.train import TrainingError

BENCHMARKS: dict[str, Benchmark] = {
    "accuracy": accuracy.BENCHMARK,
    "endurance": endurance.BENCHMARK,
    "export": export.BENCHMARK,
    "frugality": frugality.BENCHMARK,
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
        files = write_results(args.out, name, command_line(args), report)
    except BAD_INPUT as error:
        return fail(2, str(error))
    except TrainingError as error:
        return fail(1, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    for table in report.tables:
        print(table, end="\n\n")
    for entry in report.left_out:
        print(f"left out: {entry['what']}: {entry['why']}")
    print(f"written: {', '.join(map(str, files))}")
    return 0
