"""Configurations as users keep and change them: presets, files, and runs of another length."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hqgs.base.files import PLAN, read_json
from hqgs.base.typed import build
from hqgs.training.config import TrainConfig, run_config


@dataclass(frozen=True)
class Preset:
    """How long to train, and on photos of which size."""

    iterations: int | None  # None: as many as pay, 30,000 at most
    longest: int | None  # px: photos with a longer side are scaled down; None: as they are
    about: str


PRESETS = {
    "quick": Preset(1_000, 480, "a first look"),
    "standard": Preset(None, 1600, "as long as it pays"),
    "best": Preset(30_000, None, "photos as they are, the whole schedule of 3DGS"),
}


def longest_side(preset: str, downscale: float | None) -> int | None:
    """Px that a side of the photos may have: as the preset says, where no `downscale` is asked for."""
    return PRESETS[preset].longest if downscale is None else None


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
    return build(TrainConfig, values, where)


def with_iterations(config: TrainConfig, iterations: int) -> TrainConfig:
    """The configuration for a run of another length; what the user has set of its schedule stays.

    It trains all of that length: the item "iterations" is not left out.
    """
    before, after = run_config(iterations=config.iterations), run_config(iterations=iterations)

    def fitted(mine: Any, old: Any, new: Any, *names: str) -> dict[str, Any]:
        same = [name for name in names if getattr(mine, name) == getattr(old, name)]
        return {name: getattr(new, name) for name in same}

    growth = fitted(config.densify, before.densify, after.densify, "start", "stop", "every")
    return replace(
        config,
        iterations=iterations,
        leave_out=tuple(item for item in config.leave_out if item != "iterations"),
        densify=replace(config.densify, **growth),
        **fitted(config, before, after, "sh_interval", "eval_every", "checkpoint_every"),
    )


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
