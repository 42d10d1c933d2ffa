"""Finished runs as frames of pandas: means over them, and each beside the run that it is held against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pandas import DataFrame


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
