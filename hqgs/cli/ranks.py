"""A command that several processes of torchrun run together: who speaks, and what a restart goes on with."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from typing import TYPE_CHECKING

from hqgs.base.files import CHECKPOINT, lock_folder
from hqgs.base.ranks import Ranks, was_restarted

if TYPE_CHECKING:
    from hqgs.cli.train import Train


@contextmanager
def told_by_the_first(ranks: Ranks) -> Iterator[None]:
    """Nothing is shown but by the first rank; how a rank ends, each one tells."""
    if ranks.first:
        yield
        return
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        redirect_stdout(nowhere),
        redirect_stderr(nowhere),
    ):
        yield


def restarted(options: Train, ranks: Ranks) -> Train:
    """The options; where torchrun has started the run again after a fault, those that go on with it."""
    if was_restarted():
        return replace(options, resume=True, overwrite=False)
    if options.overwrite and ranks.count > 1 and ranks.first and options.out.is_dir():
        with lock_folder(options.out):  # or a restart would go on with the older run
            (options.out / CHECKPOINT).unlink(missing_ok=True)
    return options
