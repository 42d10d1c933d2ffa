"""Tables of results: CSV files with one line a run, merged by key as runs end, read by the pages.

A list stands in one cell as `a:b|c:d`. An empty cell is a number that there is not.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock
from pandas import DataFrame

import hqgs
from hqgs.base.files import write_text
from hqgs.base.machine import machine_facts, version_facts

Row = Mapping[str, Any]
RUN = ("scene", "degradation", "row", "seed", "iterations", "downscale", "poses")  # the key of a training run
KEYS: dict[str, Sequence[str]] = {  # of each table's lines
    **dict.fromkeys(("quality", "time", "endurance", "parts", "looks"), RUN),
    "poses": ("scene", "degradation", "seed", "downscale"),
    "export": ("scene", "file"),
    "stages": ("scene", "preset", "row", "round"),
    "accuracy": ("inputs", "knob", "value"),
    "speed": ("part", "case", "threads"),
    "stability": ("case", "dtype"),
}
TEXT = {  # columns whose cells are words, also where they look like numbers
    *("study", "scene", "degradation", "row", "poses", "found", "file", "inputs", "knob", "value", "part"),
    *("case", "group", "dtype", "by", "preset", "stages", "history", "failure", "machine", "commit", "date"),
    *("sources", "digest", "start", "what", "learned", "gain", "gain_shown", "off"),
}
DIGITS = ".7g"


class Table:
    """One CSV file. Several processes may add to it."""

    def __init__(self, path: Path, key: Sequence[str] | None = None) -> None:
        """`key`: the columns that tell lines apart, by default those of the table of this name."""
        self.path, self.key = path, KEYS[path.stem] if key is None else key

    def rows(self) -> list[dict[str, str]]:
        """The lines as they stand there; ValueError where the file is none of these tables."""
        if not self.path.is_file():
            return []
        with self.path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
        missing = [name for name in self.key if name not in (reader.fieldnames or ())]
        if missing or any(None in row or None in row.values() for row in rows):
            what = f"it has no column {missing[0]}" if missing else "a line has too many or too few cells"
            raise ValueError(f"{self.path} is damaged: {what}")
        return rows

    def lines(self) -> dict[tuple[str, ...], dict[str, str]]:
        """The lines by their keys."""
        return {self.key_of(line): line for line in self.rows()}

    def find(self, row: Row) -> dict[str, str] | None:
        """The line of this key."""
        return self.lines().get(self.key_of(row))

    def put(self, rows: Iterable[Row]) -> list[dict[str, str]]:
        """Add lines, each in the place of one of the same key, and write the file atomically.

        Returns them as they stand in the file.
        """
        added = [{name: text_of(value) for name, value in row.items()} for row in rows]
        with self._lock():
            self._write(list((self.lines() | {self.key_of(line): line for line in added}).values()))
        return added

    def frame(self, rows: Sequence[Row] | None = None) -> DataFrame:
        """The lines, or these of them, with numbers as numbers; NaN where there is none."""
        lines = self.rows() if rows is None else rows
        frame = DataFrame(lines, columns=None if lines else [*self.key]).fillna("")
        for name in frame.columns:
            if name not in TEXT:
                yes_no = frame[name].isin(["yes", "no", ""]).all() and frame[name].isin(["yes", "no"]).any()
                frame[name] = frame[name] == "yes" if yes_no else pd.to_numeric(frame[name])
        return frame

    def key_of(self, row: Row) -> tuple[str, ...]:
        return tuple(text_of(row[name]) for name in self.key)

    def _lock(self) -> FileLock:
        """Of this file, for all processes of this machine; it lies elsewhere, since it stays."""
        name = hashlib.sha256(str(self.path.resolve()).encode()).hexdigest()[:16]
        return FileLock(Path(tempfile.gettempdir()) / f"hqgs-{name}.lock")

    def _write(self, lines: Sequence[Row]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        heads = list(dict.fromkeys(name for line in lines for name in line)) or [*self.key]
        out = io.StringIO()
        writer = csv.DictWriter(out, heads, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
        write_text(self.path, out.getvalue())


def text_of(value: Any) -> str:
    """A value as it stands in a cell."""
    if value is None or value != value:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return format(value, DIGITS)
    if isinstance(value, Mapping):
        return "|".join(f"{name}:{text_of(one)}" for name, one in value.items())
    return str(value)


def pairs_of(text: str) -> list[tuple[str, float]]:
    """What `text_of` wrote of a mapping."""
    cells = [cell.rsplit(":", 1) for cell in text.split("|")] if text else []
    return [(name, float(value)) for name, value in cells]


def facts() -> dict[str, Any]:
    """Where and when a line was measured."""
    machine = machine_facts()
    cpu = re.sub(r"\(\w+\)|\b(CPU|Processor)\b", "", machine["cpu"])
    return {
        "threads": hqgs.get_num_threads(),
        "machine": " ".join(f"{cpu} {machine['simd']}".split()),
        "commit": short(version_facts()["git_commit"]),
        "date": datetime.now(timezone.utc).date().isoformat(),
    }


def short(commit: str | None) -> str:
    """Seven digits of a commit, and whether files differed from it."""
    first, dirty, _ = (commit or "").partition("-dirty")
    return first[:7] + dirty
