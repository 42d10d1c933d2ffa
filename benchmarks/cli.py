"""`python -m benchmarks NAME`: measure, add lines to a table of results, print them; write the pages."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import hqgs
from benchmarks import accuracy, endurance, everything, export, looks, parts, stages, time
from benchmarks.command import Benchmark
from benchmarks.pages import write as pages
from benchmarks.protocol import add_options
from benchmarks.quality import run as quality
from benchmarks.speed import run as speed
from benchmarks.stability import run as stability
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.training.trainer import TrainingError

MODULES = (accuracy, endurance, export, looks, parts, quality, speed, stability, stages, time)
BENCHMARKS: dict[str, Benchmark] = {m.__name__.split(".")[1]: m.BENCHMARK for m in MODULES}
OTHERS: dict[str, Callable[[argparse.Namespace], list[str]]] = {"all": everything.run, "pages": pages.run}


def make_parser() -> argparse.ArgumentParser:
    """A subcommand for each benchmark, one for all of them and one for the pages."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Measure what hqgs needs and how right it is."
    )
    names = parser.add_subparsers(required=True, metavar="NAME", dest="benchmark")
    for name, benchmark in BENCHMARKS.items():
        parser_of_one = names.add_parser(name, help=benchmark.help, description=benchmark.help)
        add = parser_of_one.add_argument
        out = Path("out", "bench")
        add("--out", type=Path, default=out, metavar="DIR", help=f"for {name}.csv (%(default)s)")
        add("--threads", type=int, metavar="T", help="(all cores)")
        add("--quick", action="store_true", help="tiny sizes, seconds: only a test")
        if benchmark.protocols is not None:
            add_options(parser_of_one, benchmark.protocols)
        for flag, how in benchmark.options.items():
            add(flag, **how)
    for name, module in (("all", everything), ("pages", pages)):
        module.add_options(names.add_parser(name, help=module.HELP, description=module.HELP))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a benchmark and return the exit code: 0 done, 1 failed, 2 bad input, 130 stopped by Ctrl-C."""
    args = make_parser().parse_args(argv)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM counts as Ctrl-C
    name, out = args.benchmark, args.docs if args.benchmark == "pages" else args.out
    try:
        out.mkdir(parents=True, exist_ok=True)  # an unusable place shows before the work
        if vars(args).get("threads") is not None:
            hqgs.set_num_threads(args.threads)
        printed = OTHERS[name](args) if name in OTHERS else BENCHMARKS[name].run(args)
    except KeyboardInterrupt:
        return 130
    except BAD_INPUT as error:
        return fail(2, error)
    except TrainingError as error:
        return fail(1, str(error))
    except OSError as error:
        return fail(1, f"{out}: {error}")
    print("\n\n".join(printed))
    return 0
