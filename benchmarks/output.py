"""What every benchmark gives back, and how it is written, printed and drawn."""

from __future__ import annotations

import argparse
import base64
import json
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Template
from markdown_it import MarkdownIt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame

import hqgs
from hqgs.base.files import atomic_path, write_json, write_text
from hqgs.base.machine import machine_facts, version_facts
from hqgs.base.text import markdown_table

if TYPE_CHECKING:
    from benchmarks.protocol import Protocol

BLUE, ORANGE, GREEN, GREY = "#1f6fb2", "#c2571a", "#3a8f3a", "#6b6b6b"
COLORS = (BLUE, ORANGE, GREEN, "#7b4fa3", "#b23a48", GREY, "#9a8a00", "#2a9d9d", "#d98cb3", "#000000")
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8}
NOTHING = "–"  # in the place of a number that there is not
UNTOLD = ("benchmark", "command", "out", "page")  # what of the arguments is no option, or changes no result


class UnavailableError(RuntimeError):
    """What cannot be measured here, and why."""


@dataclass
class Report:
    """The outcome of a benchmark. `settings`, `results` and `left_out` hold plain JSON values."""

    settings: dict[str, Any]
    part: str = ""  # of the benchmark, where it has several: each is written to files of its own
    results: dict[str, Any] = field(default_factory=dict)
    tables: list[str] = field(default_factory=list)  # Markdown
    figures: dict[str, Figure] = field(default_factory=dict)  # by what they show
    left_out: list[dict[str, str]] = field(default_factory=list)  # {"what", "why"}

    def leave_out(self, what: str, why: str) -> None:
        entry = {"what": what, "why": why}
        if entry not in self.left_out:
            self.left_out.append(entry)


@dataclass(frozen=True)
class Benchmark:
    """A subcommand of `python -m benchmarks`."""

    help: str
    run: Callable[[argparse.Namespace], Report]  # raises ValueError or FileNotFoundError for bad options
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


def write_results(out: Path, name: str, command: str, report: Report, page: Path | None = None) -> list[Path]:
    """Write `NAME_PART.json` and `NAME_PART_FIGURE.png` into `out`, and all of it as a page, if asked.

    Returns their paths, JSON first.
    """
    versions = version_facts()
    facts = {
        "benchmark": name,
        "command": command,
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": versions["git_commit"],
        "threads": hqgs.get_num_threads(),
        "machine": machine_facts(),
        "versions": versions,
        "settings": report.settings,
        "results": report.results,
        "left_out": report.left_out,
    }
    stem = f"{name}_{report.part}" if report.part else name
    pictures = {out / f"{stem}_{what}.png": figure for what, figure in report.figures.items()}
    for path, figure in pictures.items():
        with atomic_path(path) as tmp:
            figure.savefig(tmp)
    write_json(out / f"{stem}.json", facts)
    if page is not None:
        write_page(page, facts, report, pictures)
    return [out / f"{stem}.json", *pictures, *([] if page is None else [page])]


def command_line(args: argparse.Namespace) -> str:
    """The command that gives these results again, every option written out, folders by their name alone."""
    words = ["python", "-m", "benchmarks", args.benchmark]
    for name, value in sorted(vars(args).items()):
        if name in UNTOLD or value is None or value is False or callable(value):
            continue
        values = value if isinstance(value, list) else [] if value is True else [value]
        words += [f"--{name.replace('_', '-')}", *(v.name if isinstance(v, Path) else str(v) for v in values)]
    return shlex.join(words)


def number(value: Any, form: str) -> str:
    """A value in a format, NOTHING for None and NaN; of a list each one: `1.02 to 1.05`.

    Beside Python's formats there are `ms`, which takes seconds, and `yes|no`, the words for True and False.
    """
    if value is None or value != value:
        return NOTHING
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return " to ".join(number(one, form) for one in value)
    if "|" in form:
        return form.split("|")[not value]
    if form == "ms":
        return f"{1000 * value:.3g}" if value < 0.1 else f"{1000 * value:.0f}"
    return format(value, form)


def table(title: str, rows: Iterable[Mapping[str, Any]], columns: Mapping[str, Sequence[str]]) -> str:
    """A Markdown table of rows. `columns`: the head and the format of each by its key.

    The key `a/b` is that of what a row holds at `b` of its `a`.
    """
    paths = [(key.split("/"), form) for key, (_, form) in columns.items()]
    body = [[number(reduce(getitem, path, row), form) for path, form in paths] for row in rows]
    return markdown_table(title, [head for head, _ in columns.values()], body)


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


def color(k: int) -> str:
    """The colour of the k-th curve; beyond the last they start again."""
    return COLORS[k % len(COLORS)]


def panels(
    width: float, height: float, down: int = 1, across: int = 1, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of inches with its panels row by row, each with a grid behind the data and two spines."""
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    found = list(figure.subplots(down, across, squeeze=False, **shared).ravel())
    for axes in found:
        axes.grid(color="#dddddd", linewidth=0.7)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, found


def title(axes: Axes, text: str) -> None:
    """Above the panel, to the left; a $ in a name of a scene is no formula."""
    axes.set_title(text, fontsize=10, loc="left", parse_math=False)


def unbeaten(points: Sequence[tuple[float, float]]) -> list[int]:
    """The indices of the points that no other one beats, with less of one and no more of the other: a Pareto
    front by rising first coordinate."""

    def beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return a != b and a[0] <= b[0] and a[1] <= b[1]

    order = sorted(range(len(points)), key=lambda k: points[k])
    return [k for k in order if not any(beats(other, points[k]) for other in points)]


TEMPLATE = Path(__file__).with_name("page.html.j2")


def write_page(path: Path, facts: dict[str, Any], report: Report, pictures: Iterable[Path]) -> None:
    """Write the page atomically. `facts`: what the JSON file holds. OSError where it cannot be written."""
    template = Template(TEMPLATE.read_text(encoding="utf-8"), autoescape=True, trim_blocks=True)
    charts = {
        what.replace("_", " "): base64.b64encode(picture.read_bytes()).decode()
        for what, picture in zip(report.figures, pictures, strict=True)
    }
    page = template.render(
        title=f"hqgs benchmark {facts['benchmark']} {report.part}".rstrip(),
        facts=facts,
        tables=MarkdownIt("commonmark", {"html": False}).enable("table").render("\n\n".join(report.tables)),
        charts=charts,
        settings=json.dumps({name: facts[name] for name in ("settings", "versions")}, indent=1),
    )
    write_text(path, page)
