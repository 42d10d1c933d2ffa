"""What a benchmark runs, from the TOML file beside it; of a study the rows, degradations and seeds."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from benchmarks.scenes import BUILT_IN, EMBEDDED
from hqgs.base.typed import build
from hqgs.photos.formula import parse_degradation
from hqgs.training.config import NONE, PAPER, HQGSConfig, TrainConfig, parse_leave_out
from hqgs.training.frugality import RULES
from hqgs.training.methods.paper import VARIANTS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

T = TypeVar("T")


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; ValueError with its name where it is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name}: {error}") from error


@dataclass(frozen=True)
class Row:
    """A row of the tables: a configuration of the training."""

    label: str
    method: str = "3dgs"
    leave_out: str = NONE  # as the command line has it
    paper: Literal["", "V1", "V2", "V3", "V4", "V5", "V6", "V7"] = ""  # variant of the paper's method
    config: dict[str, Any] = field(default_factory=dict)  # further changes of the `TrainConfig`

    @property
    def more(self) -> dict[str, Any]:
        """What the result depends on, beside configuration and photos."""
        return {} if self.leave_out == NONE else {"rules": RULES}

    def train_config(self, seed: int, iterations: int, changes: dict[str, Any] | None = None) -> TrainConfig:
        """The run, its schedule fitted to its length. `changes`: of the protocol, before those of the row."""
        hqgs = HQGSConfig(guidance=PAPER, paper=VARIANTS[self.paper]) if self.paper else HQGSConfig()
        config = TrainConfig(
            iterations=iterations, method=self.method, seed=seed, hqgs=hqgs,
            leave_out=parse_leave_out(self.leave_out),
        ).scaled()  # fmt: skip
        config = build(TrainConfig, changes or {}, "the protocol's config", config)
        return build(TrainConfig, self.config, f"row {self.label!r}, config", config)


@dataclass(frozen=True)
class Protocol:
    """Everything but the scenes. All rows of a (scene, degradation, seed) see the same photos."""

    rows: tuple[Row, ...]
    iterations: int
    downscale: float
    help: str = ""
    degradations: tuple[str, ...] = (NONE,)  # as `parse_degradation` reads them
    baseline: str = ""  # the row that the others are compared with
    seeds: tuple[int, ...] = (0,)  # of the training and of the degradation
    one_scene: bool = False  # the first that is given
    embedded: tuple[int, int, int] = (504, 378, 24)  # width, height in px, views of the built-in scene
    config: dict[str, Any] = field(default_factory=dict)  # changes of every row's `TrainConfig`
    repeats: int = 1  # rounds of what is timed after the training

    @property
    def labels(self) -> list[str]:
        return [row.label for row in self.rows]

    def train_config(self, row: Row, seed: int) -> TrainConfig:
        return row.train_config(seed, self.iterations, self.config)


def read_protocols(path: Path, row_type: type[Row] = Row) -> dict[str, Protocol]:
    """The protocols of a file: `[rows.LABEL]` are rows, `[protocols.NAME]` choose among them.

    ValueError names the place of a mistake.
    """
    tables = read_toml(path)
    rows = {
        label: build(row_type, {"label": label, **table}, f"{path.name}, row {label!r}")
        for label, table in tables["rows"].items()
    }
    protocols = {}
    for name, table in tables["protocols"].items():
        where = f"{path.name}, protocol {name!r}"
        chosen = chosen_from(rows, table.get("rows", list(rows)), f"{where}, rows")
        protocol = build(Protocol, table | {"rows": chosen}, where)
        if protocol.baseline and protocol.baseline not in protocol.labels:
            raise ValueError(f"{where}: the baseline {protocol.baseline!r} is none of its rows")
        protocols[name] = narrowed(protocol)
        if protocols[name] != protocol:
            raise ValueError(f"{where}: write {', '.join(protocols[name].degradations)}")
    return protocols


def chosen_from(rows: dict[str, T], labels: Sequence[str], where: str = "rows") -> list[T]:
    """The rows of these labels, in their own order; ValueError for one that is unknown or given twice."""
    if unknown := [label for label in labels if label not in rows]:
        raise ValueError(f"{where}: there is no {unknown[0]!r}; there are: {', '.join(rows)}")
    _distinct(where, labels)
    return [row for label, row in rows.items() if label in labels]


def narrowed(protocol: Protocol, **given: Any) -> Protocol:
    """The protocol with other values where they are not None; of `rows` the labels.

    ValueError names what is unknown, given twice, or out of range.
    """
    changes = {name: value for name, value in given.items() if value is not None}
    if "seeds" in changes:
        changes["seeds"] = _distinct("seeds", changes["seeds"])
    if "rows" in changes:
        changes["rows"] = tuple(chosen_from({row.label: row for row in protocol.rows}, changes["rows"]))
    # The parser's own spelling, so that `noise:25.0` is no other run than `noise:25`.
    kinds = [str(parse_degradation(kind)) for kind in changes.get("degradations", protocol.degradations)]
    protocol = replace(protocol, **changes | {"degradations": _distinct("degradations", kinds)})
    if not protocol.downscale >= 1:
        raise ValueError(f"downscale must be at least 1, got {protocol.downscale}")
    if protocol.repeats < 1:
        raise ValueError(f"repeats is {protocol.repeats}, wanted at least 1")
    for seed in protocol.seeds:
        for row in protocol.rows:
            protocol.train_config(row, seed)  # its checks, before any work
    return protocol


def _distinct(name: str, values: Sequence[T]) -> tuple[T, ...]:
    if twice := [value for k, value in enumerate(values) if value in values[:k]]:
        raise ValueError(f"{name} holds {twice[0]} twice")
    return tuple(values)


def add_options(parser: argparse.ArgumentParser, protocol: Protocol) -> None:
    """The options that narrow a protocol, and those about finished runs."""
    parser.set_defaults(validate=False, sfm=False)
    add: Any = parser.add_argument
    built_in = ", ".join(map(str, BUILT_IN))
    add(
        "--scenes", nargs="+", type=Path, default=[EMBEDDED], metavar="SCENE",
        help=f"folders, or of {built_in}, which are built in (%(default)s)",
    )  # fmt: skip
    listed = ", ".join(protocol.labels).replace("%", "%%")
    add("--rows", nargs="+", metavar="ROW", help=f"only these of: {listed}")
    add("--seeds", nargs="+", type=int, metavar="S", help=f"({' '.join(map(str, protocol.seeds))})")
    add("--iterations", type=int, metavar="N", help=f"training steps of each run ({protocol.iterations})")
    add("--downscale", type=float, metavar="F", help=f"divide the photos' sides ({protocol.downscale:g})")
    add("--finished", action="store_true", help="train nothing: tables of the runs that are finished")
    add(
        "--known", nargs="+", type=Path, metavar="JSON",
        help="results of this benchmark from elsewhere: their runs count as finished",
    )  # fmt: skip
