"""Types of options: what `--help` calls their values, and what is said of a wrong one. None: not said."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

Spec = PrimitiveConstructorSpec[Any]
Unsaid: Any = tyro.conf.arg(help_behavior_hint="")  # whose words tell the default
KINDS: dict[Any, str] = {int: "a whole number", float: "a number"}
P = ParamSpec("P")
Options = TypeVar("Options")
T = TypeVar("T")
Result = TypeVar("Result")
PLAIN = ConstructorRegistry()  # of how other numbers are read


def values(metavar: str, wanted: str, *kinds: Callable[[str], Any]) -> Spec:
    """As many words become values of these kinds; `wanted` is told where one does not."""

    def read(words: list[str]) -> Any:
        try:
            found = [kind(word) for kind, word in zip(kinds, words, strict=True)]
        except ValueError:
            raise ValueError(f"is {' '.join(words)}, wanted {wanted}") from None
        return tuple(found) if len(found) > 1 else found[0]

    def written(value: Any) -> list[str]:
        return [str(part) for part in (value if isinstance(value, tuple) else (value,))]

    return PrimitiveConstructorSpec(len(kinds), metavar, read, lambda value: value is not None, written)


def choice(*names: str) -> Spec:
    """One of these names."""
    return replace(values(f"{{{','.join(names)}}}", "", str), choices=names)


@PLAIN.primitive_rule
def plain(info: PrimitiveTypeInfo) -> Spec | None:
    """A number."""
    kind: Any = info.type
    return values(kind.__name__.upper(), KINDS[kind], kind) if kind in KINDS else None


def given(value: T | None, default: T) -> T:
    """What was said, or else this."""
    return default if value is None else value


Number = Annotated["int | None", values("N", "a whole number", int), Unsaid]
Seed = Annotated["int | None", values("S", "a whole number", int), Unsaid]
Factor = Annotated["float | None", values("F", "a number", float), Unsaid]
Seconds = Annotated["float | None", values("S", "a number", float), Unsaid]
Size = Annotated["tuple[int, int] | None", values("W H", "two whole numbers", int, int), Unsaid]
Vector = Annotated[
    "tuple[float, float, float] | None", values("X Y Z", "three numbers", float, float, float), Unsaid
]
Color = Annotated[
    "tuple[float, float, float] | None", values("R G B", "three numbers", float, float, float), Unsaid
]
Apart = Annotated[
    "tuple[str, str, float] | None", values("A B METRES", "two names and a number", str, str, float), Unsaid
]
Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
Flag = Annotated[bool, Unsaid]


def called_with(
    options: Callable[P, Options],
) -> Callable[[Callable[[Options], Result]], Callable[P, Result]]:
    """Let a function that takes a dataclass be called with the fields of it, as its signature then says."""

    def decorate(function: Callable[[Options], Result]) -> Callable[P, Result]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> Result:
            return function(options(*args, **kwargs))

        told, kinds = inspect.signature(options), get_type_hints(options)
        shown = [given.replace(annotation=kinds[name]) for name, given in told.parameters.items()]
        result = get_type_hints(function)["return"]
        vars(call)["__signature__"] = told.replace(parameters=shown, return_annotation=result)
        return call

    return decorate
