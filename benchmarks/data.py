"""What a benchmark runs, as data: TOML files; and what it found: finished runs as frames of pandas."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pandas import DataFrame

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; ValueError with its name where it is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name}: {error}") from error


def paired(runs: DataFrame, label: str, by: Sequence[str] = ("scene", "seed")) -> DataFrame:
    """Each run beside that of row `label` with the same values of `by` (`_base`), where there is one."""
    base = runs.loc[runs["row"] == label].set_index(list(by)).add_suffix("_base")
    return runs.join(base, on=list(by), how="inner")


def means(frame: DataFrame, by: Sequence[str], values: Sequence[str]) -> DataFrame:
    """Means over the runs that share `by`, in their order; NaN where one of them lacks the number."""
    parts = frame.groupby(list(by), sort=False)[list(values)]
    return DataFrame(parts.agg(lambda v: v.astype(float).mean(skipna=False)))


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """The lines as JSON values, with the index; None for NaN."""
    lines = frame.reset_index().to_dict("records")
    return [{str(name): None if value != value else value for name, value in line.items()} for line in lines]
