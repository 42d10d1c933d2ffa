"""`all`: every study behind the pages, in processes of their own, and then the pages.

What is finished with the present sources is not run again: the studies keep their lines, and the table
`studies.csv` says which studies are done. Those of one thread run side by side, the others alone.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from shutil import copyfile
from subprocess import Popen

from benchmarks.pages import write as pages
from benchmarks.rows import KEYS, Table, facts
from benchmarks.study import sources
from hqgs.cli.progress import duration

HELP = "run every study behind the pages that is not finished, then write the pages"
DONE, ONE_CORE = "studies.csv", "--threads 1"
PAUSE = 0.2  # seconds between looks at what runs


def add_options(parser: argparse.ArgumentParser) -> None:
    """Where captures, tables and pages are."""
    add = parser.add_argument
    add("--captures", type=Path, metavar="DIR", help="of the captures, a folder each: fern, fox, ...")
    add("--out", type=Path, default=Path("out", "all"), metavar="DIR", help="for the tables (%(default)s)")
    add("--jobs", type=int, default=1, metavar="N", help="studies of one thread side by side (%(default)s)")
    add("--only", nargs="+", metavar="STUDY", help=f"of: {', '.join(pages.STUDIES)}")
    add("--quick", action="store_true", help="each benchmark once in seconds, no pages: only a test")
    pages.add_docs(parser)


def command_of(options: str, captures: Path | None) -> list[str]:
    """The arguments of a study; a word in capitals is a folder of the captures."""
    words = []
    for word in shlex.split(options):
        if word.isupper() and not word.startswith("-"):
            if captures is None:
                raise ValueError(f"captures: wanted the folder that has {word.lower()}")
            folder = captures / word.lower()
            if not folder.is_dir():
                raise FileNotFoundError(f"there is no capture {folder}")
            words.append(str(folder))
        else:
            words.append(word)
    return words


def commands(args: argparse.Namespace) -> dict[str, list[str]]:
    """The arguments of each study that is asked for, by its name; ValueError for a name that is none."""
    if args.quick:
        return {
            name: [name, "--quick"] for name in dict.fromkeys(o.split()[0] for o in pages.STUDIES.values())
        }
    wanted = list(pages.STUDIES) if args.only is None else args.only
    if unknown := [name for name in wanted if name not in pages.STUDIES]:
        raise ValueError(f"only: there is no {unknown[0]!r}; there are: {', '.join(pages.STUDIES)}")
    return {name: command_of(pages.STUDIES[name], args.captures) for name in wanted}


def publish(out: Path, results: Path) -> None:
    """Put the tables of `out` in the place of the pages'."""
    results.mkdir(parents=True, exist_ok=True)
    for path in [out / f"{name}.csv" for name in KEYS]:
        if path.is_file():
            copyfile(path, results / path.name)


def run(args: argparse.Namespace) -> list[str]:
    """Run what is not finished; returns what is left to do, or what was written."""
    done, wanted = Table(args.out / DONE, ("study",)), commands(args)
    known = {line["study"] for line in done.rows() if line["sources"] == sources()}
    missing = {name: words for name, words in wanted.items() if name not in known}
    beside = {name: words for name, words in missing.items() if ONE_CORE in shlex.join(words)}
    alone = {name: words for name, words in missing.items() if name not in beside}  # they measure time
    left: list[str] = []
    for studies, jobs in ((beside, args.jobs), (alone, 1)):
        for name, code, seconds in side_by_side(studies, jobs, ["--out", str(args.out)]):
            if code == 130:
                raise KeyboardInterrupt
            say(f"{name}: exit code {code}, {duration(seconds)}")
            if code == 0:
                done.put([{"study": name, "seconds": seconds} | facts() | {"sources": sources()}])
            else:
                left.append(f"{name}: exit code {code}")
    if left or args.quick or args.only is not None:
        return [*left, f"tables: {args.out}; no pages were written"]
    publish(args.out, args.docs / pages.RESULTS)
    return [f"written: {path}" for path in pages.write(args.docs / pages.RESULTS, args.docs)]


def side_by_side(
    studies: Mapping[str, list[str]], jobs: int, more: Sequence[str]
) -> Generator[tuple[str, int, float], None, None]:
    """Run studies, so many at a time; the name, exit code and seconds of each as it ends."""
    left, running = list(studies), dict[str, tuple[Popen[bytes], float]]()
    try:
        while left or running:
            while left and len(running) < jobs:
                name = left.pop(0)
                say(f"{name}: {shlex.join(studies[name])}")
                running[name] = start([*studies[name], *more]), time.perf_counter()
            time.sleep(PAUSE)
            for name, (process, started) in list(running.items()):
                if (code := process.poll()) is not None:
                    del running[name]
                    yield name, code, time.perf_counter() - started
    finally:
        for process, _ in running.values():
            process.terminate()
            process.wait()


def start(words: Sequence[str]) -> Popen[bytes]:
    """A benchmark in a process of its own, whose memory is its own."""
    return Popen([sys.executable, "-m", "benchmarks", *words])


def say(text: str) -> None:
    print(f"all: {text}", file=sys.stderr, flush=True)
