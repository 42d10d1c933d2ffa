"""The templates of pages and of their charts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from markupsafe import Markup

TEMPLATES = Path(__file__).parent / "templates"


def filled(template: str, **values: Any) -> Markup:
    """A template with these values, which are escaped."""
    from jinja2 import Environment, FileSystemLoader  # here: only a page needs it

    loader = FileSystemLoader(TEMPLATES)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return Markup(environment.get_template(template).render(**values))
