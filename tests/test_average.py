"""The scene at the end of a run: the mean over its last steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from planned import run_config
from tiny_scene import tiny_config, tiny_scene

from hqgs.training.config import TrainConfig
from hqgs.training.plan import Facts
from hqgs.training.rules import plan_run
from hqgs.training.state import Average
from hqgs.training.trainer import Trainer

ITERATIONS, COUNTED = 30, 6  # the last 30 % are the steps after 21; what grows until 25 is not counted in


def asked(averaged: float | None, method: str = "3dgs") -> TrainConfig:
    return replace(tiny_config(ITERATIONS, method=method), averaged=averaged)


def trained(averaged: float | None, steps: int = ITERATIONS) -> tuple[Trainer, list[torch.Tensor]]:
    """A trainer after these steps, and its colours after each of them."""
    trainer, colors = Trainer(tiny_scene(), asked(averaged)), []
    for _ in range(steps):
        trainer.step()
        colors.append(trainer.gaussians.sh0.detach().clone())
    return trainer, colors


def test_the_scene_is_the_mean_over_the_last_steps_and_training_goes_on_from_the_last() -> None:
    plain, _ = trained(0.0)
    trainer, colors = trained(0.3)
    wanted = torch.stack(colors[-COUNTED:]).double().mean(dim=0)
    torch.testing.assert_close(trainer.shown().sh0.double(), wanted, rtol=1e-6, atol=1e-6)
    assert not torch.equal(trainer.shown().sh0, colors[-1])
    for name, tensor in plain.gaussians.named().items():
        assert torch.equal(trainer.gaussians.named()[name], tensor), name
    assert torch.equal(plain.shown().sh0, colors[-1])


def test_a_run_that_goes_on_has_the_same_mean(tmp_path: Path) -> None:
    whole, _ = trained(0.3)
    half, _ = trained(0.3, ITERATIONS - 1)
    assert half.state.average.count == COUNTED - 1
    half.save(tmp_path / "checkpoint")
    other = Trainer(tiny_scene(), asked(0.3))
    other.restore(tmp_path / "checkpoint")
    other.step()
    for name, tensor in whole.shown().named().items():
        assert torch.equal(other.shown().named()[name], tensor), name


def test_a_longer_run_and_one_that_loses_rows_begin_the_mean_anew(tmp_path: Path) -> None:
    trainer, _ = trained(0.3)
    trainer.save(tmp_path / "checkpoint")
    longer = Trainer(tiny_scene(), replace(tiny_config(2 * ITERATIONS, method="3dgs"), averaged=0.3))
    longer.restore(tmp_path / "checkpoint")
    assert longer.state.average.count == 0
    assert torch.equal(longer.shown().sh0, longer.gaussians.sh0.detach())
    some = torch.zeros(len(trainer.gaussians), dtype=torch.bool)
    some[3] = True
    trainer._remove(some)
    assert trainer.state.average.count == 0
    assert len(trainer.shown()) == len(some) - 1


def test_a_damaged_mean_is_refused(tmp_path: Path) -> None:
    trainer, _ = trained(0.3)
    trainer.state.average.means["sh0"] = torch.zeros(3)
    trainer.save(tmp_path / "checkpoint")
    with pytest.raises(ValueError, match=r"average\.sh0 is torch\.float32 \[3\]"):
        Trainer(tiny_scene(), asked(0.3)).restore(tmp_path / "checkpoint")


def test_nothing_counted_in_is_the_scene_itself() -> None:
    gaussians = Trainer(tiny_scene(), asked(0.0)).gaussians
    assert Average().of(gaussians) is gaussians


def test_the_plan_asks_for_it_where_renders_are_formed_as_photos_were() -> None:
    facts = Facts(30, 10_000, 100, 50, True, None, as_photographed=True, sizes=((100, 100),) * 30)
    config = run_config(iterations=1000, method="hqgs", formation="none")
    plan = plan_run(facts, None, config)
    assert plan.settings.averaged == 0.05
    assert "5%" in next(row for row in plan.rows if row.what == "scene at the end").value
    assert plan_run(facts, None, replace(config, averaged=0.0)).settings.averaged == 0.0
    assert plan_run(facts, None, run_config(iterations=1000, method="3dgs")).settings.averaged is None
