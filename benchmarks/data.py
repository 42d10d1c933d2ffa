"""What a benchmark runs, as data: TOML files read into dataclasses, with each mistake named by its place."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

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


def build(kind: type[T], table: Mapping[str, Any], where: str) -> T:
    """A dataclass from a table of its fields, tables of tables for the dataclasses within it.

    ValueError names the place of an unknown, missing or mistyped field, and of one that the class refuses.
    """
    hints = get_type_hints(kind)
    own: Any = fields(kind)  # type: ignore[arg-type]
    _refuse_unknown(table, [f.name for f in own], where)
    for f in own:
        if f.name not in table and f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"{where}: {f.name} is missing")
    values = {name: _value(hints[name], value, f"{where}, {name}") for name, value in table.items()}
    try:
        return kind(**values)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def overridden(config: T, changes: Mapping[str, Any], where: str) -> T:
    """A copy of a configuration with other values, tables of them for what is a dataclass in it."""
    hints = get_type_hints(type(config))
    _refuse_unknown(changes, hints, where)
    values = {}
    for name, value in changes.items():
        current, place = getattr(config, name), f"{where}, {name}"
        nested = is_dataclass(current) and isinstance(value, Mapping)
        values[name] = overridden(current, value, place) if nested else _value(hints[name], value, place)
    try:
        return replace(config, **values)  # type: ignore[type-var]
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _refuse_unknown(table: Mapping[str, Any], known: Any, where: str) -> None:
    if unknown := [name for name in table if name not in known]:
        raise ValueError(f"{where}: there is no {unknown[0]!r}; there are: {', '.join(known)}")


def _value(hint: Any, value: Any, where: str) -> Any:
    """A value of TOML as the type that the field has: lists become tuples, whole numbers floats."""
    kind, args = get_origin(hint), get_args(hint)
    if hint is Any or (kind is dict and isinstance(value, dict)):
        return value
    if kind in (Union, UnionType):
        (hint,) = [arg for arg in args if arg is not type(None)]
        return None if value is None else _value(hint, value, where)
    if kind is tuple and isinstance(value, list | tuple):
        hints = [args[0]] * len(value) if args[-1] is Ellipsis else args
        if len(hints) != len(value):
            raise ValueError(f"{where}: {len(value)} values, wanted {len(hints)}")
        return tuple(_value(h, v, f"{where}[{k}]") for k, (h, v) in enumerate(zip(hints, value, strict=True)))
    if kind is Literal and value in args:
        return value
    if isinstance(hint, type):
        if is_dataclass(hint) and isinstance(value, Mapping):
            return build(hint, value, where)
        if hint is float and type(value) is int:
            return float(value)
        if isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
            return value
    raise ValueError(f"{where}: {value!r:.60} is not of the type {getattr(hint, '__name__', hint)}")
