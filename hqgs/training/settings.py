"""Configurations as users keep and change them: presets, files, and runs of another length."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_type_hints

from hqgs.base.files import PLAN
from hqgs.training.config import TrainConfig, run_config

T = TypeVar("T")
SCHEDULE = ("sh_interval", "eval_every", "checkpoint_every")  # fields that follow from the length
GROWTH = ("start", "stop", "every")  # those of `TrainConfig.densify`


@dataclass(frozen=True)
class Preset:
    """How long to train, and on photos of which size."""

    iterations: int | None  # None: at most 30,000, fewer where the scene has stopped improving
    longest: int | None  # px: photos with a longer side are scaled down; None: as they are
    about: str


PRESETS = {
    "quick": Preset(1_000, 480, "a first look"),
    "standard": Preset(None, 1600, "until the scene has stopped improving"),
    "best": Preset(30_000, None, "photos as they are, the whole schedule of 3DGS"),
}


def config_values(config: TrainConfig) -> dict[str, Any]:
    """A configuration as JSON values, as `read_config` takes it."""
    return json.loads(json.dumps(asdict(config)))


def read_config(path: str | Path) -> TrainConfig:
    """The configuration in a file: config.json of a run, or the fields of `TrainConfig` alone.

    Fields that are missing have their defaults. FileNotFoundError, or ValueError that names the field.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"there is no configuration {path}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from error
    if isinstance(values, dict) and isinstance(values.get("train"), dict):
        values = values["train"]
    return config_of_values(values, str(path))


def config_of_values(values: Any, where: str) -> TrainConfig:
    """The configuration of JSON values, of `where`. ValueError that names the field."""
    return _build(TrainConfig, values, where)


def with_iterations(config: TrainConfig, iterations: int) -> TrainConfig:
    """The configuration for a run of another length; what the user has set of its schedule stays.

    It trains all of that length: the item "iterations" is not left out.
    """
    before, after = run_config(iterations=config.iterations), run_config(iterations=iterations)

    def fitted(mine: Any, old: Any, new: Any, names: tuple[str, ...]) -> dict[str, Any]:
        same = [name for name in names if getattr(mine, name) == getattr(old, name)]
        return {name: getattr(new, name) for name in same}

    return replace(
        config,
        iterations=iterations,
        leave_out=tuple(item for item in config.leave_out if item != "iterations"),
        densify=replace(config.densify, **fitted(config.densify, before.densify, after.densify, GROWTH)),
        **fitted(config, before, after, SCHEDULE),
    )


def plan_values(config: TrainConfig) -> dict[str, Any]:
    """How long the run of a configuration was, as JSON values; `with_plan` reads it."""
    return {"iterations": config.iterations, "turn": None if config.turn is None else list(config.turn)}


def with_plan(config: TrainConfig, path: str | Path) -> TrainConfig:
    """The configuration with the length that a run with a number of seconds came to: plan.json, or the run's
    folder. FileNotFoundError, or ValueError that says what is wrong with it."""
    path = Path(path) / PLAN if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no plan {path}; runs with a number of seconds write one")
    try:
        plan = json.loads(path.read_text(encoding="utf-8"))
        iterations, turn = plan["iterations"], plan["turn"]
        turn = None if turn is None else (int(turn[0]), int(turn[1]))
        return replace(with_iterations(config, int(iterations)), seconds=None, turn=turn)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"{path} is no plan: {error!r}") from error


def _build(kind: type[T], values: Any, where: str) -> T:
    """A dataclass of JSON values. ValueError for a field that there is not, or one of another type."""
    if not isinstance(values, dict):
        raise ValueError(f"{where}: wanted an object with fields, got {values!r:.60}")
    hints, found = get_type_hints(kind), dict[str, Any]()
    for name, value in values.items():
        if name not in {field.name for field in fields(kind)}:  # pyright: ignore[reportArgumentType]
            known = ", ".join(field.name for field in fields(kind))  # pyright: ignore[reportArgumentType]
            raise ValueError(f"{where}: there is no field {name!r}; there are: {known}")
        found[name] = _value(hints[name], value, f"{where}: {name}")
    try:
        return kind(**found)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _value(hint: Any, value: Any, where: str) -> Any:
    options = [one for one in get_args(hint) if one is not NoneType]
    if value is None and NoneType in get_args(hint):
        return None
    inner = options[0] if NoneType in get_args(hint) else hint
    if is_dataclass(inner) and isinstance(inner, type):
        return _build(inner, value, where)
    if isinstance(value, list) and getattr(inner, "__origin__", None) is tuple:
        return tuple(value)
    simple = {int: int, float: (int, float), bool: bool, str: str}.get(inner, object)
    if not isinstance(value, simple) or (isinstance(value, bool) and inner in (int, float)):
        raise ValueError(f"{where} is {value!r}, wanted {getattr(inner, '__name__', inner)}")
    return value
