"""A command that several processes of torchrun run together: who speaks, and what a restart goes on with."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from hqgs.base.files import CHECKPOINT, lock_folder
from hqgs.base.ranks import Ranks, was_restarted


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


def restarted(out: Path, overwrite: bool, ranks: Ranks) -> bool:
    """Whether torchrun has started the run in `out` again after a fault, so that it goes on.

    With `overwrite` a first start removes the checkpoint there, or a restart would go on with the older run.
    """
    if was_restarted():
        return True
    if overwrite and ranks.count > 1 and ranks.first and out.is_dir():
        with lock_folder(out):
            (out / CHECKPOINT).unlink(missing_ok=True)
    return False
