"""A benchmark as one HTML file without network: command, commit, machine, tables and charts."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader

from hqgs.base.files import write_text

if TYPE_CHECKING:
    from benchmarks.output import Report

TEMPLATE = Path(__file__).with_name("page.html.j2")


def write_page(path: Path, facts: dict[str, Any], report: Report) -> None:
    """Write the page atomically. `facts`: what the JSON file holds. OSError where it cannot be written."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATE.parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    charts = {}
    for what, figure in report.figures.items():
        png = io.BytesIO()
        figure.savefig(png, format="png")
        charts[what.replace("_", " ")] = f"data:image/png;base64,{base64.b64encode(png.getvalue()).decode()}"
    page = environment.get_template(TEMPLATE.name).render(
        title=f"hqgs benchmark {facts['benchmark']} {report.part}".rstrip(),
        facts=facts,
        blocks=[block for text in report.tables for block in _blocks(text)],
        charts=charts,
        settings=json.dumps({name: facts[name] for name in ("settings", "versions")}, indent=1),
    )
    write_text(path, page)


def _blocks(text: str) -> Iterator[tuple[str, Any]]:
    """Of Markdown as the benchmarks print it: titles, tables as rows of cells, and other text."""
    for block in text.split("\n\n"):
        if block.startswith("**") and block.endswith("**"):
            yield "title", block.strip("*")
        elif block.startswith("|"):
            rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in block.splitlines()]
            yield "table", [rows[0], *rows[2:]]
        else:
            yield "text", block
