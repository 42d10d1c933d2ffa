"""How the pages are built: `sphinx-build -W -b html docs out/docs`, where a warning is an error."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import textwrap
import tokenize
from typing import Any

import hqgs

project = "hqgs"
author = "the hqgs authors"
release = hqgs.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
default_role = "code"  # docstrings write code between single backticks, as Markdown does
myst_heading_anchors = 3
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"hqgs {release}"
html_show_copyright = False
html_show_sourcelink = False


def field_comments(cls: type) -> dict[str, str]:
    """The comments behind the fields of a class, which hold shapes and units, by field."""
    source = textwrap.dedent(inspect.getsource(cls))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {t.start[0]: t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT}
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            found[node.target.id] = " ".join(comments[line] for line in lines if line in comments)
    return {name: text.removeprefix("noqa: N815").strip() for name, text in found.items()}


def add_fields(_app: Any, what: str, _name: str, obj: Any, _options: Any, lines: list[str]) -> None:
    """Append the fields of a dataclass to its docstring, for `sphinx.ext.napoleon` to lay out."""
    if what != "class" or not isinstance(obj, type) or not dataclasses.is_dataclass(obj):
        return
    comments = field_comments(obj)
    lines += ["", "Attributes:"]
    for field in dataclasses.fields(obj):
        if not field.name.startswith("_"):
            text = comments.get(field.name, "")
            for sign in "\\*|_":
                text = text.replace(sign, f"\\{sign}") if "`" not in text else text
            lines.append(f"    {field.name}: {text}")
    lines.append("")


def plain_defaults(*event: Any) -> tuple[str, str] | None:
    """The signature of a dataclass whose default `<factory>` Sphinx cannot parse."""
    args, returns = event[-2:]
    return (args.replace("<factory>", "..."), returns) if args and "<factory>" in args else None


def setup(app: Any) -> None:
    """`add_fields` comes before napoleon, which has the default priority of 500."""
    app.connect("autodoc-process-docstring", add_fields, priority=400)
    app.connect("autodoc-process-signature", plain_defaults)
