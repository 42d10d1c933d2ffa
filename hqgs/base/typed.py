"""Dataclasses of plain values, as JSON and TOML have them; each mistake is named by its place."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")


def build(kind: type[T], values: Any, where: str, base: T | None = None, part: str = "") -> T:
    """A dataclass of the values of its fields, objects with fields for the dataclasses within it.

    Lists become tuples, and whole numbers floats where the field is one. With `base`: a copy of it, with
    other values for what `values` names. ValueError, which begins with `where` (if that tells anything) and
    names the field, in its `part`, for an unknown, missing or mistyped field, and for one that the class
    refuses.
    """
    place = f"{where}: " if where else ""
    inside = f"{place}{part[:-1]}: " if part else place
    if not isinstance(values, dict):
        raise ValueError(f"{inside}wanted an object with fields, got {values!r:.60}")
    hints, known = get_type_hints(kind), [field.name for field in fields(kind)]  # type: ignore[arg-type]
    found: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{inside}unknown field {name!r}; there are: {', '.join(known)}")
        found[name] = _value(hints[name], value, where, f"{part}{name}", getattr(base, name, None))
    try:
        return kind(**found) if base is None else replace(base, **found)  # type: ignore[type-var]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{place}{error}") from error


def _value(hint: Any, value: Any, where: str, name: str, base: Any = None) -> Any:
    args = get_args(hint)
    if NoneType in args:
        (hint,) = [arg for arg in args if arg is not NoneType]
        return None if value is None else _value(hint, value, where, name, base)
    kind = get_origin(hint) or hint
    if kind is Any or (kind is Literal and value in args):
        return value
    place = f"{where}: " if where else ""
    if kind is tuple and isinstance(value, list | tuple):
        hints = [args[0]] * len(value) if args[-1] is Ellipsis else args
        if len(hints) != len(value):
            raise ValueError(f"{place}{name} has {len(value)} values, wanted {len(hints)}")
        return tuple(
            _value(h, v, where, f"{name}[{k}]") for k, (h, v) in enumerate(zip(hints, value, strict=True))
        )
    if kind is list and isinstance(value, list):
        return [_value(args[0], v, where, f"{name}[{k}]") for k, v in enumerate(value)]
    if kind is dict and isinstance(value, dict):
        return {key: _value(args[1], v, where, f"{name}[{key!r}]") for key, v in value.items()}
    if is_dataclass(kind) and isinstance(kind, type) and not isinstance(value, kind):
        return build(kind, value, where, base, f"{name}.")
    if kind is float and type(value) is int:
        return float(value)
    if isinstance(kind, type) and isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
        return value
    wanted = f"one of {', '.join(map(str, args))}" if kind is Literal else getattr(hint, "__name__", hint)
    raise ValueError(f"{place}{name} is {value!r:.60}, wanted {wanted}")
