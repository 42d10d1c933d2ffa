"""Words and tables for people."""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Sequence


def markdown_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table under a bold title; the first column to the left, the others to the right."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]

    def line(cells: Sequence[str]) -> str:
        padded = [
            c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(cells, widths, strict=True))
        ]
        return f"| {' | '.join(padded)} |"

    rule = [("-" * w) if k == 0 else "-" * (w - 1) + ":" for k, w in enumerate(widths)]
    return "\n".join([f"**{title}**", "", line(head), line(rule), *map(line, rows)])


def aligned(rows: Sequence[Sequence[str]], width: int | None = None) -> str:
    """Columns one beside the other; the last one is wrapped to `width` (None: the terminal's)."""
    width = shutil.get_terminal_size((110, 24)).columns if width is None else width
    before = [max(map(len, column)) for column in list(zip(*rows, strict=True))[:-1]]
    indent = sum(before) + 2 * len(before)
    lines = []
    for *cells, last in rows:
        first = "".join(f"{cell:{size}}  " for cell, size in zip(cells, before, strict=True))
        wrapped = textwrap.wrap(last, max(width - indent, 40)) or [""]
        lines += [(first + wrapped[0]).rstrip(), *(" " * indent + more for more in wrapped[1:])]
    return "\n".join(lines)


def some(names: list[str]) -> str:
    """The first few names, for messages."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def as_text(name: str) -> str:
    """A name or text from disk that can be written as UTF-8: bytes that are none become %E9 and such."""
    return re.sub("[\ud800-\udfff]", lambda found: f"%{ord(found[0]) & 0xFF:02X}", name)
