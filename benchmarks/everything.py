"""`all`: every study behind the pages, in processes of their own, and then the pages.

What is finished with the present sources is not run again: the studies keep their lines, and the table
`studies.csv` says which studies are done. The lines that other programs gave stay.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.pages import write as pages
from benchmarks.pages.sections import EXTERNAL
from benchmarks.rows import KEYS, Table, facts
from benchmarks.study import sources
from hqgs.cli.progress import duration

HELP = "run every study behind the pages that is not finished, then write the pages"
DONE = "studies.csv"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Where captures, tables and pages are."""
    add = parser.add_argument
    add("--captures", type=Path, metavar="DIR", help="of the captures, a folder each: fern, fox, ...")
    add("--out", type=Path, default=Path("out", "all"), metavar="DIR", help="for the tables (%(default)s)")
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
    """Put the lines of `out` in the place of those of the pages' tables; rows of other programs stay."""
    for name in KEYS:
        lines = Table(out / f"{name}.csv").rows()
        if lines:
            table = Table(results / f"{name}.csv")
            table.keep(lambda line: line.get("row") in EXTERNAL)
            table.put(lines)


def run(args: argparse.Namespace) -> list[str]:
    """Run what is not finished; returns what is left to do, or what was written."""
    done = Table(args.out / DONE, ("study",))
    left: list[str] = []
    for name, words in commands(args).items():
        line = done.find({"study": name})
        if line is not None and line["sources"] == sources():
            continue
        print(f"all: {name}: {shlex.join(words)}", file=sys.stderr, flush=True)
        started = time.perf_counter()
        code = call([*words, "--out", str(args.out)])
        if code == 130:
            raise KeyboardInterrupt
        seconds = time.perf_counter() - started
        print(f"all: {name}: exit code {code}, {duration(seconds)}", file=sys.stderr, flush=True)
        if code == 0:
            done.put([{"study": name, "seconds": seconds} | facts() | {"sources": sources()}])
        else:
            left.append(f"{name}: exit code {code}")
    if left or args.quick or args.only is not None:
        return [*left, f"tables: {args.out}; no pages were written"]
    publish(args.out, args.docs / pages.RESULTS)
    return [f"written: {path}" for path in pages.write(args.docs / pages.RESULTS, args.docs)]


def call(words: Sequence[str]) -> int:
    """The exit code of a benchmark in a process of its own, whose memory is its own."""
    return subprocess.run([sys.executable, "-m", "benchmarks", *words], check=False).returncode
