"""What a benchmark runs, as data: TOML files read into dataclasses, with each mistake named by its place."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

T = TypeVar("T")


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; ValueError with its name where it is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path.name}: {error}") from error


def build(kind: type[T], table: Mapping[str, Any], where: str, base: T | None = None) -> T:
    """A dataclass from a table of its fields, tables of tables for the dataclasses within it.

    With `base` a copy of it, with other values for what the table names. ValueError names the place of an
    unknown, missing or mistyped field, and of one that the class refuses.
    """
    hints = get_type_hints(kind)
    if unknown := [name for name in table if name not in hints]:
        raise ValueError(f"{where}: there is no {unknown[0]!r}; there are: {', '.join(hints)}")
    values = {
        name: _value(hints[name], value, f"{where}, {name}", getattr(base, name, None))
        for name, value in table.items()
    }
    try:
        return kind(**values) if base is None else replace(base, **values)  # type: ignore[type-var]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _value(hint: Any, value: Any, where: str, base: Any = None) -> Any:
    """A value of TOML as the type that the field has: lists become tuples, whole numbers floats."""
    kind, args = get_origin(hint), get_args(hint)
    if kind is UnionType:
        (hint,) = [arg for arg in args if arg is not type(None)]
        return _value(hint, value, where, base)
    if hint is Any or kind is dict or (kind is Literal and value in args):
        return value
    if kind is tuple and isinstance(value, list | tuple):
        hints = [args[0]] * len(value) if args[-1] is Ellipsis else args
        if len(hints) != len(value):
            raise ValueError(f"{where}: {len(value)} values, wanted {len(hints)}")
        return tuple(_value(h, v, f"{where}[{k}]") for k, (h, v) in enumerate(zip(hints, value, strict=True)))
    if isinstance(hint, type):
        if is_dataclass(hint) and isinstance(value, Mapping):
            return build(hint, value, where, base)
        if hint is float and type(value) is int:
            return float(value)
        if isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
            return value
    wanted = hint.__name__ if isinstance(hint, type) else hint
    raise ValueError(f"{where}: {value!r:.60} is not of the type {wanted}")
