"""Configurations in files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hqgs.base.files import PLAN, read_json
from hqgs.base.typed import build
from hqgs.training.config import LEFT, TrainConfig, with_iterations


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
    values = read_json(path)
    if isinstance(values, dict) and isinstance(values.get("train"), dict):
        values = values["train"]
    return config_of_values(values, str(path))


def config_of_values(values: Any, where: str) -> TrainConfig:
    """The configuration of JSON values, of `where`. ValueError that names the field."""
    if isinstance(values, dict):  # of a former version too
        if isinstance(items := values.get("leave_out"), list):
            values = values | {"leave_out": [item for item in items if item not in LEFT]}
        if isinstance(hqgs := values.get("hqgs"), dict):
            values = values | {"hqgs": {name: value for name, value in hqgs.items() if name != "paper"}}
    return build(TrainConfig, values, where)


def plan_values(config: TrainConfig, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How long the run of these settings was, as JSON values, which `with_plan` reads; and its rows."""
    turn = None if config.turn is None else list(config.turn)
    return {"iterations": config.iterations, "turn": turn, "rows": list(rows)}


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
        return replace(with_iterations(config, int(iterations)), seconds=None, turn=turn, timed=True)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"{path} is no plan: {error!r}") from error
