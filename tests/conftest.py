"""How the suite runs: the whole of it in a process for each core, a part of it in one."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

MOST = 4  # processes; each takes up to 1.5 GB
IN_WORKER = "PYTEST_XDIST_WORKER" in os.environ

if IN_WORKER:  # before torch and the crate are imported: the cores are taken by the other processes
    for name in ("OMP_NUM_THREADS", "RAYON_NUM_THREADS"):
        os.environ.setdefault(name, "1")

if sys.dont_write_bytecode:  # as in many containers: each of some hundred processes would compile torch anew
    sys.pycache_prefix = str(Path(__file__).parent.parent / ".pytest_cache" / "bytecode")
    sys.dont_write_bytecode = False
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import torch  # noqa: E402  # not before threads are set
from fixtures_cards import cards, found_cards, photos  # noqa: E402, F401

import benchmarks.scenes.kinds  # noqa: E402, F401  # tests degrade photos in all ways that the benchmarks know
import hqgs  # noqa: E402

THREADS = hqgs.get_num_threads(), torch.get_num_threads()


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """`pytest` alone: as many processes as there are cores. `-n 0` keeps it to one; where pytest-xdist is
    missing it is one too."""
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if IN_WORKER or not whole or not config.pluginmanager.hasplugin("xdist"):
        return
    if config.option.numprocesses is None and not config.option.usepdb:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        config.option.numprocesses = min(cores, MOST)
        config.option.dist = "worksteal"


@pytest.fixture(autouse=True)
def as_many_threads_as_alone() -> Iterator[None]:
    """What a test sets changes no other."""
    yield
    hqgs.set_num_threads(THREADS[0])
    torch.set_num_threads(THREADS[1])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say why tests were skipped."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = Counter(report.longrepr[2].removeprefix("Skipped: ") for report in skipped)
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} skipped: {reason}")
