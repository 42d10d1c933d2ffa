"""Functions of hqgs replaced by expressions, here and in processes that are started from here.

A function's code is replaced, not its name, so that whoever imported it before calls the other one. Only the
standard library is imported: `site/sitecustomize.py` does the same in COLMAP's process.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from types import FunctionType
from typing import Any

VARIABLE = "HQGS_WITHOUT"  # of the environment: the replacements, for processes
BODY = """def neutral(*args, **kwargs):
    from dataclasses import replace
    import numpy as np
    import hqgs
    from benchmarks.without import WERE
    was = WERE[{place!r}]
    return {expression}"""
WERE: dict[str, FunctionType] = {}  # the functions as they are without a replacement, by their places


def function_at(place: str) -> FunctionType:
    """The function of `package.module:name`; ValueError where there is none."""
    module, name = place.split(":")
    try:
        found = attrgetter(name)(importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        raise ValueError(f"there is no {place}: {error}") from error
    if not isinstance(found, FunctionType) or found.__closure__:
        raise ValueError(f"{place} is no plain function")
    return found


def replace_function(place: str, expression: str) -> None:
    """Make a function return an expression of `args`, `kwargs` and `was`, the function itself."""
    function, made = function_at(place), dict[str, Any]()
    WERE[place] = FunctionType(function.__code__, function.__globals__, function.__name__)
    WERE[place].__defaults__, WERE[place].__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    exec(BODY.format(place=place, expression=expression), made)
    function.__code__, function.__defaults__, function.__kwdefaults__ = made["neutral"].__code__, None, None


def put_back(place: str) -> None:
    """Undo `replace_function`."""
    function, was = function_at(place), WERE.pop(place)
    function.__code__, function.__defaults__ = was.__code__, was.__defaults__
    function.__kwdefaults__ = was.__kwdefaults__


@contextmanager
def without(replacements: Mapping[str, str]) -> Iterator[None]:
    """Inside, the functions at these places are what the expressions say."""
    before = {name: os.environ.get(name) for name in (VARIABLE, "PYTHONPATH")}
    here = Path(__file__).parent
    paths = [str(here / "site"), str(here.parent), before["PYTHONPATH"] or ""]
    done = list[str]()
    try:
        for place, expression in replacements.items():
            replace_function(place, expression)
            done.append(place)
        if replacements:
            os.environ |= {VARIABLE: json.dumps(dict(replacements)), "PYTHONPATH": os.pathsep.join(paths)}
        yield
    finally:
        for place in done:
            put_back(place)
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
