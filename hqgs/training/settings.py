"""What was said of a run, in files: config.json and plan.json of a run, or fields of `TrainConfig` alone."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hqgs.base.files import CHECKPOINT, CONFIG, PLAN, read_json
from hqgs.training.config import Said, TrainConfig, decided, merged


def config_values(config: TrainConfig) -> dict[str, Any]:
    """A configuration as JSON values, whole: with the numbers of `TrainConfig.due`."""
    return json.loads(json.dumps(asdict(config.fitted())))


def said_by(config: TrainConfig) -> Said:
    """A configuration as what somebody has said: all of it, but for what it leaves to the plan."""
    known = {name: value for name, value in vars(config).items() if value is not None and name != "due"}
    parts = ("densify", "srgs", "hqgs")
    return known | {p: {k: v for k, v in vars(known[p]).items() if v is not None} for p in parts}


def read_said(path: str | Path) -> Said:
    """What a file says: config.json of a run, or some fields of `TrainConfig`.

    FileNotFoundError, or ValueError that names the field.
    """
    path = Path(path) / CONFIG if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no configuration {path}")
    values = read_json(path)
    if not isinstance(values, dict):
        raise ValueError(f"{path}: wanted an object with fields, got {values!r:.60}")
    said = values.get("said", values)
    if "train" in said:
        raise ValueError(f"{path} is of an older version of hqgs, which did not tell what was asked for")
    decided(said, str(path))
    return said


def resumed(folder: Path, now: Said) -> Said:
    """What is said of the run in a folder, before and now. ValueError where it would be shorter."""
    before = read_said(folder) if (folder / CHECKPOINT).exists() and (folder / CONFIG).is_file() else {}
    said = merged(before, now)
    if "iterations" in before and "iterations" in now and said["iterations"] < before["iterations"]:
        raise ValueError(
            f"iterations is {said['iterations']}, and the run in {folder} has {before['iterations']}: "
            "--resume can make a run longer, not shorter"
        )
    return said


def plan_values(config: TrainConfig, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How long the run of these settings was, as JSON values, which `read_plan` reads; and its rows."""
    turn = None if config.turn is None else list(config.turn)
    return {"iterations": config.iterations, "turn": turn, "rows": list(rows)}


def read_plan(path: str | Path) -> Said:
    """The length that a run with a number of seconds came to, as what somebody has said: of plan.json, or of
    the run's folder. FileNotFoundError, or ValueError that says what is wrong with it."""
    path = Path(path) / PLAN if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no plan {path}; runs with a number of seconds write one")
    try:
        plan = json.loads(path.read_text(encoding="utf-8"))
        said: Said = {"iterations": int(plan["iterations"]), "turn": plan["turn"], "timed": True}
        decided(said)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"{path} is not a plan: {error!r}") from error
    return said
