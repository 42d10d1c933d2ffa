"""`pages`: the pages of results, written whole from the tables."""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks import looks, parts, stages
from benchmarks.pages import figures, sections
from benchmarks.protocol import read_toml
from benchmarks.rows import KEYS, Table
from hqgs.base.files import write_text

HERE = Path(__file__).parent
STUDIES: dict[str, str] = read_toml(HERE.parent / "studies.toml")["studies"]
DOCS = HERE.parents[1] / "docs"
HELP = "write the pages of results from their tables"
RESULTS = Path("results")  # in the folder of the documentation: pages and tables
INDEX = "results.md"
HELPERS = (figures, looks, parts, sections, stages)  # whose functions the templates call


def tables(folder: Path) -> dict[str, Any]:
    """The frames of all tables by name."""
    return {name: Table(folder / f"{name}.csv").frame() for name in KEYS}


def command(*names: str) -> str:
    """The commands of these studies, as a block."""
    lines = "\n".join(f"python -m benchmarks {STUDIES[name]}" for name in names)
    return f"```sh\n{lines}\n```"


@cache
def environment() -> Environment:
    """The templates, and what they may call."""
    found = Environment(
        loader=FileSystemLoader(HERE), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True, autoescape=False,
    )  # fmt: skip
    found.globals["command"] = command
    for module in HELPERS:
        public = {
            name: one
            for name, one in vars(module).items()
            if getattr(one, "__module__", "") == module.__name__
        }
        found.globals |= public
    return found


def pages(folder: Path) -> dict[Path, str]:
    """The text of each page by its path in the documentation's folder. `folder`: of the tables."""
    data = tables(folder)
    found = {}
    for template in sorted(HERE.glob("*.md.j2")):
        name = template.name.removesuffix(".j2")
        path = Path(name) if name == INDEX else RESULTS / name
        found[path] = environment().get_template(template.name).render(data)
    return found


def write(folder: Path, docs: Path) -> list[Path]:
    """Write the pages of the tables in `folder` into `docs`; returns their paths."""
    found = pages(folder)
    for path, text in found.items():
        write_text(docs / path, text)
    return [docs / path for path in found]


def add_docs(parser: argparse.ArgumentParser) -> None:
    """Where the pages are written."""
    parser.add_argument("--docs", type=Path, default=DOCS, metavar="DIR", help="for the pages (docs)")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Where the tables are, and where the pages go."""
    help = "of the tables (docs/results)"
    parser.add_argument("--tables", type=Path, default=DOCS / RESULTS, metavar="DIR", help=help)
    add_docs(parser)


def run(args: argparse.Namespace) -> list[str]:
    """Write all pages and say which."""
    return [f"written: {path}" for path in write(args.tables, args.docs)]
