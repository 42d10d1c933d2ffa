"""Finished runs as frames of pandas: means over them, and each beside the run that it is held against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pandas import DataFrame

PAIR = ["scene", "seed"]  # what a run shares with the one that it is held against


def paired(runs: DataFrame, label: str) -> DataFrame:
    """Each run beside that of row `label` of the same scene and seed (`_base`), where there is one."""
    base = runs.loc[runs["row"] == label].set_index(PAIR).add_suffix("_base")
    return runs.join(base, on=PAIR, how="inner")


def means(frame: DataFrame, by: Sequence[str], values: Sequence[str]) -> DataFrame:
    """Means over the runs that share `by`, in their order; NaN where one of them lacks the number."""
    parts = frame.groupby(list(by), sort=False)[list(values)]
    return DataFrame(parts.agg(lambda v: v.astype(float).mean(skipna=False)))


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """The lines as JSON values, with the index; None for NaN."""
    lines = frame.reset_index().to_dict("records")
    return [{str(name): None if value != value else value for name, value in line.items()} for line in lines]
