"""What a subcommand of `python -m benchmarks` is, and the options of what is timed."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.protocol import Protocol


class UnavailableError(RuntimeError):
    """What cannot be measured here, and why."""


@dataclass(frozen=True)
class Benchmark:
    """A subcommand that measures: it adds lines to the table of its name in `--out`."""

    help: str
    run: Callable[[argparse.Namespace], list[str]]  # returns what is printed, Markdown; ValueError or
    # FileNotFoundError for bad options
    protocols: dict[str, Protocol] | None = None  # of a study
    options: Mapping[str, dict[str, Any]] = field(default_factory=dict)  # beyond those of all, for argparse


TIMED: dict[str, dict[str, Any]] = {  # the options of what is timed
    "--repeats": {"type": int, "metavar": "N", "help": "rounds of each measurement"},
    "--seed": {"type": int, "default": 2026, "metavar": "S", "help": "of the Gaussians (%(default)s)"},
}


def sizes_of(data: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """The table `quick` or `full` of what is timed, with what the options `TIMED` ask for."""
    sizes = data["quick" if args.quick else "full"] | {"seed": args.seed}
    repeats = sizes["repeats"] if args.repeats is None else args.repeats
    if repeats < 1:
        raise ValueError(f"repeats is {repeats}, wanted at least 1")
    return sizes | {"repeats": repeats}
