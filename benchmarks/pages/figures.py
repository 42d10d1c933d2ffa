"""What the pages compute of the tables: means, gains with their scatter, tables, where runs are from.

A gain is the mean of differences between two rows in runs that share scene, photos, seed and length. Its
scatter is half its interval (`hqgs.evaluation.intervals`) over captures, whose runs go together; over runs
where there is one capture. A difference within it is not called a gain.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from pandas import DataFrame

from benchmarks.rows import RUN
from hqgs.evaluation.intervals import half_width

NOTHING = "–"  # in the place of a number that there is not
GROUP = [name for name in RUN if name != "row"]  # what runs share that are compared


def pick(frame: DataFrame, **wanted: Any) -> DataFrame:
    """The runs with these values; of a column with a list of values, in its order."""
    for name, value in wanted.items():
        values = [value] if isinstance(value, (str, int, float)) else list(value)
        frame = frame.loc[frame[name].isin(values)]
        if len(values) > 1:
            frame = frame.sort_values(name, key=lambda column: column.map(values.index), kind="stable")
    return frame


@dataclass(frozen=True)
class Gain:
    """Of a row over another, run by run."""

    runs: DataFrame  # the columns of `GROUP`, and `gain`
    base: str = ""

    @cached_property
    def count(self) -> int:
        return len(self.runs)

    @cached_property
    def mean(self) -> float:
        return float(self.runs["gain"].mean())

    @cached_property
    def worst(self) -> float:
        return float(self.runs["gain"].min())

    @cached_property
    def error(self) -> float | None:
        """Half the interval of the mean over captures, or of one over its runs; None of a single run."""
        gains: dict[str, list[float]] = {}
        for scene, value in zip(self.runs["scene"], self.runs["gain"], strict=True):
            gains.setdefault(capture(scene), []).append(float(value))
        means = [sum(values) / len(values) for values in gains.values()]
        return half_width(means if len(means) > 1 else [one for values in gains.values() for one in values])

    @property
    def sure(self) -> bool:
        return self.error is not None and abs(self.mean) > self.error

    def text(self, form: str = "+.2f") -> str:
        """`+1.99 ± 0.36`."""
        if not self.count:
            return NOTHING
        return format(self.mean, form) + ("" if self.error is None else f" ± {format(self.error, form[1:])}")

    def words(self, unit: str = "dB", form: str = ".2f") -> str:
        """What may be said of it: that it gains, that it loses, or neither."""
        if not self.count:
            return "was not measured"
        if self.error is None:
            side = "above" if self.mean >= 0 else "below"
            return f"is {abs(self.mean):{form}} {unit} {side} `{self.base}` in one run"
        if not self.sure:
            return f"does not differ from `{self.base}` beyond scatter ({self.text('+' + form)} {unit})"
        verb, to = ("gains", "over") if self.mean > 0 else ("loses", "to")
        return f"{verb} {abs(self.mean):{form}} ± {self.error:{form}} {unit} {to} `{self.base}`"


def capture(scene: str) -> str:
    """What a scene is of: `fern` of `fern-3`, `beyond` of `beyond:8`."""
    return re.sub(r"[-:][0-9]+$", "", scene)


def gain(frame: DataFrame, row: str, base: str, value: str = "psnr", **wanted: Any) -> Gain:
    """Differences of two rows in the runs with these values."""
    frame = pick(frame, **wanted)
    frame = frame if value in frame else frame.assign(**{value: np.nan})  # not measured yet
    sides = [frame.loc[frame["row"] == label].set_index(GROUP)[value] for label in (row, base)]
    first, second = (side.dropna().astype(float) for side in sides)
    joined = pd.concat([first, second], axis=1, join="inner", keys=["a", "b"])
    return Gain((joined["a"] - joined["b"]).rename("gain").reset_index(), base)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column to the left, the others to the right."""
    first, *others = (f"| {' | '.join(line)} |" for line in (heads, *rows))
    return "\n".join([first, f"|---|{'--:|' * (len(heads) - 1)}", *others])


def listed(frame: DataFrame, columns: Mapping[str, tuple[str, str]]) -> str:
    """A line for each run. `columns`: head and format by the column's name."""
    rows = [[number(line[name], form) for name, (_, form) in columns.items()] for line in records(frame)]
    return table([head for head, _ in columns.values()], rows)


def crossed(
    frame: DataFrame,
    value: str = "psnr",
    down: str = "row",
    across: str = "degradation",
    also: Mapping[str, tuple[str, str]] = MappingProxyType({}),
) -> str:
    """Means of the runs by two columns. `also`: further columns of each line, means of all of its runs."""
    labels, heads = (list(dict.fromkeys(frame[column])) for column in (down, across))
    body = []
    for label in labels:
        part = frame.loc[frame[down] == label]
        line = [mean(part.loc[part[across] == head], value) for head in heads]
        body.append([str(label), *line, *(mean(part, key, form) for key, (_, form) in also.items())])
    return table(["", *map(str, heads), *(head for head, _ in also.values())], body)


def gains(
    frame: DataFrame, rows: Sequence[str], base: str, across: str = "degradation", corner: str = "gain (dB)"
) -> str:
    """Gains over the base with their scatter, a line for each row; the last column: of all runs."""
    heads = list(dict.fromkeys(frame[across]))
    parts = [*(frame.loc[frame[across] == head] for head in heads), frame]
    body = [[row, *(gain(part, row, base).text() for part in parts)] for row in rows]
    return table([corner, *map(str, heads), "all"], body)


def mean(frame: DataFrame, value: str = "psnr", form: str = ".2f") -> str:
    """The mean over the runs, NOTHING where one of them lacks the number; of words each one, once."""
    values = list(frame[value]) if value in frame else []
    if any(isinstance(one, str) for one in values):
        return ", ".join(dict.fromkeys(values)) or NOTHING
    return number(sum(values) / len(values) if values else None, form)


def number(value: Any, form: str) -> str:
    """A value in a format; `ms` takes seconds, `yes|no` are the words for True and False."""
    if value is None or value != value:
        return NOTHING
    if isinstance(value, str):
        return value or NOTHING
    if "|" in form:
        return form.split("|")[not value]
    if form == "ms":
        return f"{1000 * value:.3g}" if value < 0.1 else f"{1000 * value:.0f}"
    return format(value, form)


def records(frame: DataFrame) -> list[dict[str, Any]]:
    return [{str(name): value for name, value in line.items()} for line in frame.to_dict("records")]


def and_list(words: Sequence[str]) -> str:
    """`a, b and c`."""
    return " and ".join([*([", ".join(words[:-1])] if len(words) > 1 else []), *words[-1:]])


def made(*frames: DataFrame) -> str:
    """Where the runs of a page are from: number, commits, machines, dates."""
    columns = ["commit", "machine", "date", "sources"]
    parts = [frame.reindex(columns=columns) for frame in frames if len(frame)]
    if not parts:
        return "Not measured yet."
    runs = pd.concat(parts, ignore_index=True).sort_values(["date", "commit"], kind="stable")
    commits, machines, dates = (list(dict.fromkeys(filter(None, runs[name]))) for name in columns[:3])
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    text = f"{len(runs)} lines; commit{'s' * (len(commits) > 1)} {', '.join(commits)}; "
    text += f"{and_list(sorted(machines))}; {when}."
    same = len(commits) == 1 or runs["sources"].fillna(runs["commit"]).nunique() == 1
    return text + ("" if same else " Not of one code and machine: cells compare roughly.")


def weakest(frame: DataFrame, row: str = "hqgs", base: str = "3dgs") -> str:
    """Where the row gains least, and most: `jpeg:20 (+0.34 dB), most under noise:50 (+6.54 dB)`."""
    found = {kind: gain(frame, row, base, degradation=kind) for kind in dict.fromkeys(frame["degradation"])}
    known = {kind: one.mean for kind, one in found.items() if one.count}
    least, most = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
    return f"{least} ({known[least]:+.2f} dB), most under {most} ({known[most]:+.2f} dB)"


def beside(
    frame: DataFrame,
    down: str = "degradation",
    scenes: Sequence[str] = (),
    row: str = "hqgs",
    base: str = "3dgs",
    words: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """A row beside the base, a line for each value of `down`: its gain in each scene, in all, at worst.

    `words`: what those values are called, in their order.
    """
    body = []
    for label in words or dict.fromkeys(frame[down]):
        part = frame.loc[frame[down] == label]
        whole = gain(part, row, base)
        means = [mean(pick(part, row=name)) for name in (base, row)]
        cells = [gain(part, row, base, scene=scene).text() for scene in scenes]
        worst = format(whole.worst, "+.2f") if whole.count else NOTHING
        body.append([words.get(label, str(label)), *means, *cells, whole.text(), worst])
    return table(["", f"`{base}`", f"`{row}`", *scenes, "gain", "worst run"], body)
