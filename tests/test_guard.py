"""The guard: what is not finite is named, culled or skipped where it first appears, and training goes on."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_method import install
from run_state import run_until
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

from hqgs.base.files import CHECKPOINT
from hqgs.model.gaussians import Gaussians
from hqgs.pipeline import train
from hqgs.training.adam import select_rows
from hqgs.training.config import DensifyConfig
from hqgs.training.guard import EVENTS_KEPT, GAUSSIANS_LISTED, are_sound, bad_rows
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.trainer import Trainer

ONLY_TRAIN = DensifyConfig(stop=0)


class Spoil(torch.autograd.Function):
    """The identity whose gradient has a wrong value in some rows."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, rows: list[int], value: float) -> Tensor:  # type: ignore[override]
        ctx.rows, ctx.value = rows, value
        return x.clone()

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        v = v.clone()
        v[ctx.rows] = ctx.value
        return v, None, None


class Faulty(ThreeDGS):
    """3DGS with an own tensor, and gradients that go wrong in one step."""

    def __init__(self) -> None:
        self.steps = 0
        self.at = 4
        self.tensor = ""
        self.rows: list[int] = []
        self.value = torch.nan
        self.offset = torch.zeros(3, requires_grad=True)

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        named = gaussians.named()
        offset = self.offset
        if torch.is_grad_enabled():
            self.steps += 1
            if self.steps == self.at and self.tensor == "offset":
                offset = Spoil.apply(offset, [0], self.value)
            elif self.steps == self.at and self.tensor:
                named[self.tensor] = Spoil.apply(named[self.tensor], self.rows, self.value)
        return Gaussians(**(named | {"sh0": named["sh0"] + offset}))

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "offset", "params": [self.offset], "lr": 0.0}]


@pytest.fixture
def faulty(monkeypatch: pytest.MonkeyPatch) -> Faulty:
    method = Faulty()
    install(monkeypatch, "faulty", method)
    return method


def values(trainer: Trainer) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in trainer.gaussians.named().items()}


@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e19])
@pytest.mark.parametrize("tensor", ["means", "scales", "quats", "opacities", "sh0"])
def test_gaussians_with_a_bad_gradient_are_named_and_culled(
    faulty: Faulty, tensor: str, value: float
) -> None:
    faulty.tensor, faulty.rows, faulty.value = tensor, [3, 17], value
    trainer = run_until(Trainer(tiny_scene(), tiny_config(method="faulty", densify=ONLY_TRAIN)), 3)
    before = values(trainer)
    moments = trainer.state.optimizer.state[trainer.gaussians.means]["exp_avg"].clone()
    step = trainer.step()
    rest = [i for i in range(40) if i not in (3, 17)]
    for name, tensor_before in before.items():  # the step changed nothing else: Adam has not seen it
        assert torch.equal(trainer.gaussians.named()[name], tensor_before[rest]), name
    assert torch.equal(trainer.state.optimizer.state[trainer.gaussians.means]["exp_avg"], moments[rest])
    assert trainer.state.guard.events == [
        {
            "iteration": 4,
            "view": step.view.name,
            "what": "gradient",
            "tensors": [tensor],
            "count": 2,
            "gaussians": [3, 17],
        }
    ]
    assert (trainer.state.guard.skipped, trainer.state.guard.culled) == (1, 2)
    for _ in range(20):
        trainer.step()
    assert (trainer.state.guard.skipped, trainer.state.guard.culled, trainer.state.guard.num_events) == (
        1,
        2,
        1,
    )
    assert all(bool(torch.isfinite(t).all()) for t in values(trainer).values())


@pytest.mark.parametrize(
    ("tensor", "value"),
    [
        *itertools.product(["means", "quats", "sh0"], [torch.nan, -torch.inf]),
        ("scales", torch.nan),
        ("opacities", torch.nan),
    ],
)
def test_a_bad_parameter_is_culled_and_the_others_train_as_if_it_had_not_been(
    tensor: str, value: float
) -> None:
    config = tiny_config(densify=ONLY_TRAIN)
    trainer, expected = Trainer(tiny_scene(), config), Trainer(tiny_scene(), config)
    for _ in range(5):
        trainer.step()
        expected.step()
    with torch.no_grad():
        trainer.gaussians.named()[tensor][11] = value
    rest = torch.tensor([i for i in range(40) if i != 11])
    select_rows(expected.gaussians, expected.state.optimizer, rest, old=39)
    expected.state.densifier.grad_sum, expected.state.densifier.count = torch.zeros(39), torch.zeros(39)
    step = trainer.step()
    expected.step()
    assert [(e["what"], e["tensors"], e["gaussians"]) for e in trainer.state.guard.events] == [
        ("parameter", [tensor], [11])
    ]
    assert trainer.state.guard.events[0]["view"] == step.view.name
    assert trainer.state.guard.skipped == 0
    for _ in range(4):
        trainer.step()
        expected.step()
    for name, wanted in values(expected).items():
        assert torch.equal(trainer.gaussians.named()[name], wanted), name


def test_children_that_would_lie_nowhere_are_culled() -> None:
    """exp(88.7) is about the largest float: the children of a Gaussian of that size lie at infinity."""
    trainer = run_until(Trainer(tiny_scene(), tiny_config()), 7)
    with torch.no_grad():
        trainer.gaussians.scales[4] = 88.7
        trainer.gaussians.shN[9, 2, 1] = torch.nan  # this tensor is looked at where rows change
        trainer.state.densifier.grad_sum[4] = 1e6
    trainer.step()  # the round at 8
    assert all(bool(torch.isfinite(t).all()) for t in values(trainer).values())
    (event,) = trainer.state.guard.events
    assert (event["what"], event["iteration"]) == ("parameter", 8)
    assert set(event["tensors"]) == {"means", "shN"}
    assert trainer.state.guard.culled == event["count"] >= 3
    assert len(trainer.gaussians) == len(trainer.state.densifier.count) > 0
    trainer.step()


def test_a_gaussian_of_infinite_size_is_culled() -> None:
    """exp(89) overflows: it is not rendered, and nothing would move it."""
    trainer = Trainer(tiny_scene(), tiny_config())
    with torch.no_grad():
        trainer.gaussians.scales[4, 1] = 89.0
    trainer.step()
    (event,) = trainer.state.guard.events
    assert (event["what"], event["tensors"], event["gaussians"]) == ("parameter", ["scales"], [4])


def test_a_photo_that_is_not_finite_is_named_and_the_others_are_trained_on(tmp_path: Path) -> None:
    scene = tiny_scene()
    image = scene.train[2].image.astype(np.float32) / 255
    image[3, 4:7, 1] = np.nan
    bad = replace(scene.train[2], image=image)
    scene = replace(scene, train=[*scene.train[:2], bad, *scene.train[3:]])
    train(scene, config=tiny_config(densify=ONLY_TRAIN), out=tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    guard = report["guard"]
    assert guard["skipped_steps"] == guard["num_events"] == 6  # 30 steps, five views
    assert {(e["view"], e["what"], e["count"]) for e in guard["events"]} == {("view3.png", "photo", 3)}
    assert guard["culled_gaussians"] == 0
    assert report["history"][-1]["psnr"] > report["history"][0]["psnr"]
    assert {"what": "6 training steps", "why": "the loss or a gradient was NaN or Inf"} in report["left_out"]


def test_an_unexplained_loss_names_the_view(faulty: Faulty, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Faulty.loss
    monkeypatch.setattr(Faulty, "loss", lambda self, r, v: real(self, r, v) * torch.nan)
    trainer = Trainer(tiny_scene(), tiny_config(method="faulty"))
    step = trainer.step()
    (event,) = trainer.state.guard.events
    assert (event["what"], event["view"], event["count"]) == ("loss", step.view.name, 0)


def test_a_method_s_own_gradient_is_named_and_costs_no_gaussian(faulty: Faulty) -> None:
    faulty.tensor = "offset"
    trainer = run_until(Trainer(tiny_scene(), tiny_config(method="faulty", densify=ONLY_TRAIN)), 6)
    (event,) = trainer.state.guard.events
    assert (event["what"], event["tensors"], event["count"]) == ("gradient", ["offset"], 0)
    assert (trainer.state.guard.skipped, trainer.state.guard.culled, len(trainer.gaussians)) == (1, 0, 40)


def test_many_events_are_counted_and_the_first_kept(faulty: Faulty) -> None:
    faulty.tensor, faulty.rows = "means", list(range(15))
    trainer = Trainer(tiny_scene(num_points=800), tiny_config(60, method="faulty", densify=ONLY_TRAIN))
    for k in range(EVENTS_KEPT + 5):
        faulty.steps, faulty.at = 0, 1
        trainer.step()
        faulty.at = 0
        trainer.step()
        assert trainer.state.guard.culled == 15 * (k + 1)
    assert trainer.state.guard.num_events == EVENTS_KEPT + 5
    assert [e["iteration"] for e in trainer.state.guard.events] == list(range(1, 2 * EVENTS_KEPT, 2))
    assert all(
        e["gaussians"] == list(range(GAUSSIANS_LISTED)) and e["count"] == 15
        for e in trainer.state.guard.events
    )


def test_what_the_guard_knows_outlives_a_checkpoint(faulty: Faulty, tmp_path: Path) -> None:
    faulty.tensor, faulty.rows = "sh0", [1]
    trainer = run_until(Trainer(tiny_scene(), tiny_config(method="faulty")), 5)
    trainer.save(tmp_path / CHECKPOINT)
    again = Trainer(tiny_scene(), tiny_config(method="faulty"))
    again.restore(tmp_path / CHECKPOINT)
    assert again.state.guard == trainer.state.guard
    assert again.state.guard.culled == 1
    assert len(again.gaussians) == 39


def test_the_report_of_a_healthy_run(tmp_path: Path) -> None:
    train(tiny_scene(), config=tiny_config(), out=tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["guard"] == {"skipped_steps": 0, "culled_gaussians": 0, "num_events": 0, "events": []}


def test_one_look_finds_what_the_rows_would() -> None:
    sound = torch.tensor([1e17, -9e17, 0.0])
    assert are_sound([("a", sound), ("b", sound.double().expand(4, 3).T)])
    assert not are_sound([("a", sound), ("b", torch.tensor([-88.0]))], b=88)
    for bad in (torch.inf, -torch.inf, torch.nan, 1.1e18, -1.1e18):
        for dtype in (torch.float32, torch.float64):
            values = torch.full((4000, 3), 9e17, dtype=dtype)
            assert are_sound([("a", sound), ("b", values)])
            values[2345, 1] = bad
            assert not are_sound([("a", sound), ("b", values)])
            names, rows = bad_rows({"a": values, "b": torch.zeros(4000)})
            assert names == ["a"]
            assert rows.nonzero().tolist() == [[2345]]
