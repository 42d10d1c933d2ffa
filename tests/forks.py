"""Processes that start from one in which everything is imported already: a fraction of a second each."""

from __future__ import annotations

import multiprocessing
from multiprocessing.context import ForkServerContext

from hqgs.cli import main as cli

LIBRARIES = ("hqgs.cli.main", "hqgs.pipeline", "hqgs.scene.source", "hqgs.base.ranks", "piq", "pytest")


def forks() -> ForkServerContext:
    """Its `Process` runs a function of a test file in such a process."""
    context = multiprocessing.get_context("forkserver")
    # None of the tests' own modules: their path is not set there.
    context.set_forkserver_preload([*(place for place, _ in cli.COMMANDS.values()), *LIBRARIES])
    return context
