"""Print every text of hqgs/ that can reach a person: file, line, words, so that all can be read in one list.

python scripts/messages.py            all of them
python scripts/messages.py scene cli  those of files whose path holds one of the words
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

HOUSE = Path(__file__).parent.parent / "hqgs"
FEWEST_WORDS = 4  # shorter texts are names, keys and parts of a table


def spoken(node: ast.AST) -> str | None:
    """The text of a literal or an f-string, the holes of which stand as {expression}."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if not isinstance(node, ast.JoinedStr):
        return None
    holes = [
        ast.unparse(part.value) if isinstance(part, ast.FormattedValue) else None for part in node.values
    ]
    return "".join(spoken(part) or f"{{{hole}}}" for part, hole in zip(node.values, holes, strict=True))


def is_option(node: ast.AST) -> bool:
    """Whether the docstrings in this class are the help of options: a dataclass of the command line."""
    return isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(d) for d in node.decorator_list)


def messages(node: ast.AST, of_options: bool) -> Iterator[tuple[int, str]]:
    """Line and words of what is said in the node; docstrings count in classes of options alone."""
    for child in ast.iter_child_nodes(node):
        docstring = isinstance(child, ast.Expr) and spoken(child.value) is not None
        if docstring and not (of_options and is_option(node)):
            continue
        words = spoken(child)
        if words is None:
            yield from messages(child, of_options)
        elif len(words.split()) >= FEWEST_WORDS:
            yield child.lineno, " ".join(words.split())  # pyright: ignore[reportAttributeAccessIssue]


def main(wanted: list[str]) -> None:
    for path in sorted(HOUSE.rglob("*.py")):
        name = path.relative_to(HOUSE.parent).as_posix()
        if wanted and not any(word in name for word in wanted):
            continue
        of_options = "/cli/" in name or path.name in {"options.py", "config.py"}
        for line, words in messages(ast.parse(path.read_text(encoding="utf-8")), of_options):
            print(f"{name}:{line}: {words}")


if __name__ == "__main__":
    main(sys.argv[1:])
