"""`python -m benchmarks NAME`: measure, print Markdown tables, write one JSON file and charts."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Sequence
from pathlib import Path

import hqgs
from benchmarks import accuracy, endurance, export, features, frugality, time
from benchmarks.output import Benchmark, command_line, write_results
from benchmarks.pages import write as pages
from benchmarks.protocol import add_options
from benchmarks.quality import run as quality
from benchmarks.speed import run as speed
from benchmarks.stability import run as stability
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.training.trainer import TrainingError

MODULES = (accuracy, endurance, export, features, frugality, quality, speed, stability, time)
BENCHMARKS: dict[str, Benchmark] = {m.__name__.split(".")[1]: m.BENCHMARK for m in MODULES}


def make_parser() -> argparse.ArgumentParser:
    """A subcommand for each benchmark."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Measure what hqgs needs and how right it is."
    )
    names = parser.add_subparsers(required=True, metavar="NAME", dest="benchmark")
    for name, benchmark in BENCHMARKS.items():
        parser_of_one = names.add_parser(name, help=benchmark.help, description=benchmark.help)
        add = parser_of_one.add_argument
        out = Path("out", "bench")
        add("--out", type=Path, default=out, metavar="DIR", help=f"for {name}.json (%(default)s)")
        add("--page", type=Path, metavar="FILE", help="also write all of it as one HTML file")
        add("--threads", type=int, metavar="T", help="(all cores)")
        add("--quick", action="store_true", help="tiny sizes, seconds: only a test")
        if benchmark.protocols is not None:
            add_options(parser_of_one, benchmark.protocols["standard"])
        for flag, how in benchmark.options.items():
            add(flag, **how)
    pages.add_options(names.add_parser("pages", help="write the pages of results from their tables"))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a benchmark and return the exit code: 0 done, 1 failed, 2 bad input, 130 stopped by Ctrl-C."""
    args = make_parser().parse_args(argv)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM counts as Ctrl-C
    try:
        if args.benchmark == "pages":
            pages.run(args)
            return 0
        args.out.mkdir(parents=True, exist_ok=True)  # an unusable place shows before the work
        if args.page is not None and args.page.is_dir():
            raise ValueError(f"--page {args.page} is a folder: name a file")
        if args.threads is not None:
            hqgs.set_num_threads(args.threads)
        report = BENCHMARKS[args.benchmark].run(args)
        files = write_results(args.out, args.benchmark, command_line(args), report, args.page)
    except KeyboardInterrupt:
        return 130
    except BAD_INPUT as error:
        return fail(2, error)
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
