"""Plans and schedules of runs without a trainer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tiny_scene import tiny_scene

from hqgs.scene.scene import View
from hqgs.training.config import TrainConfig, TrainOptions, decided, merged, read_plan, said_by
from hqgs.training.plan import RunPlan
from hqgs.training.prepare import facts_of
from hqgs.training.rules import plan_run
from hqgs.training.schedule import Schedule


def run_config(**said: Any) -> TrainConfig:
    """The configuration of a run of these options."""
    return decided(TrainOptions(**said).said())


def planned(config: TrainConfig, views: Sequence[View], as_photographed: bool = True) -> RunPlan:
    """Of a run on these views."""
    facts = facts_of(replace(tiny_scene(), train=list(views)))
    return plan_run(replace(facts, as_photographed=as_photographed), None, config)


def schedule_of(config: TrainConfig, views: Sequence[View], as_photographed: bool = True) -> Schedule:
    return Schedule.of(planned(config, views, as_photographed), len(views))


def repeated(config: TrainConfig, run: Path) -> TrainConfig:
    """With the length that the seconds of another run came to, as its folder tells it."""
    return decided(merged(said_by(config), read_plan(run)))
