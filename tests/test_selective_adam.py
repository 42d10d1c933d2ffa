"""`TrainConfig.selective_adam`: only what a view shows is updated, and a resumed run is the same run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_method import install
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

from hqgs.scene.scene import Scene
from hqgs.training.adam import Adam
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.methods.base import Target, ThreeDGS
from hqgs.training.trainer import Trainer

SELECTIVE = tiny_config(selective_adam=True)


def with_points_behind() -> Scene:
    """The tiny scene and ten more points that no camera sees."""
    scene = tiny_scene()
    rng = np.random.default_rng(1)
    behind = rng.uniform([-1, -1, -9], [1, 1, -8], (10, 3)).astype(np.float32)
    colors = np.full((10, 3), 90, np.uint8)
    return replace(
        scene,
        points=np.concatenate([scene.points, behind]),
        point_colors=np.concatenate([scene.point_colors, colors]),
    )


def state(trainer: Trainer) -> dict[str, bytes]:
    """All that is trained, and its moments."""
    tensors: dict[str, Tensor] = dict(trainer.gaussians.named())
    for name, tensor in trainer.gaussians.named().items():
        tensors |= {f"{name}.{key}": value for key, value in trainer.state.optimizer.state[tensor].items()}
    return {name: tensor.detach().numpy().tobytes() for name, tensor in tensors.items()}


def test_it_is_off_by_default() -> None:
    assert TrainConfig().selective_adam is False


def test_off_every_row_is_updated_and_on_only_the_visible_ones() -> None:
    config = tiny_config(densify=DensifyConfig(stop=0), sh_interval=1)
    moved = {}
    for selective in (False, True):
        trainer = Trainer(with_points_behind(), replace(config, selective_adam=selective))
        for group in trainer.state.optimizer.param_groups:  # moments that go on moving without a gradient
            for param in group["params"]:
                moments = {"exp_avg": torch.ones_like(param), "exp_avg_sq": torch.ones_like(param)}
                trainer.state.optimizer.state[param] = {"step": torch.tensor(1.0), **moments}
        before = trainer.gaussians.opacities.detach().clone()
        trainer.step()
        moved[selective] = trainer.gaussians.opacities.detach() != before
    assert moved[False].all()
    assert not moved[True][-10:].any()
    assert moved[True][:-10].any()


@pytest.mark.parametrize("stop", [1, 8, 12, 23])
def test_a_resumed_run_is_the_same_run(tmp_path: Path, stop: int) -> None:
    whole, first = (Trainer(with_points_behind(), SELECTIVE) for _ in range(2))
    for _ in range(30):
        whole.step()
    for _ in range(stop):
        first.step()
    first.save(tmp_path / "a.safetensors")
    second = Trainer(with_points_behind(), SELECTIVE)
    second.restore(tmp_path / "a.safetensors")
    while second.iteration < 30:
        second.step()
    assert state(second) == state(whole)


def test_a_run_of_the_other_kind_is_refused(tmp_path: Path) -> None:
    trainer = Trainer(tiny_scene(), tiny_config())
    trainer.step()
    trainer.save(tmp_path / "a.safetensors")
    with pytest.raises(ValueError, match="another selective_adam: False there, True in this run"):
        Trainer(tiny_scene(), SELECTIVE).restore(tmp_path / "a.safetensors")


def test_the_tensors_of_a_method_are_always_updated(monkeypatch: pytest.MonkeyPatch) -> None:
    class Offset(ThreeDGS):
        def __init__(self) -> None:
            self.offset = torch.zeros(7, requires_grad=True)  # not a row for each Gaussian

        def param_groups(self) -> list[dict[str, Any]]:
            return [{"name": "offset", "params": [self.offset], "lr": 0.01}]

        def loss(self, image: Tensor, target: Target) -> Tensor:
            return super().loss(image, target) + self.offset.sum()

    method = Offset()
    install(monkeypatch, "offset", method)
    trainer = Trainer(tiny_scene(), replace(SELECTIVE, method="offset"))
    trainer.step()
    assert torch.allclose(method.offset.detach(), torch.full((7,), -0.01))


def test_groups_with_every_row_take_no_notice_of_what_is_visible() -> None:
    some, every = (torch.zeros(3, requires_grad=True) for _ in range(2))
    optimizer = Adam([{"params": [some]}, {"params": [every], "every_row": True}], lr=0.1)
    some.grad, every.grad = torch.ones(3), torch.ones(3)
    optimizer.step(visible=torch.tensor([True, False, True]))
    assert (some.detach() != 0).tolist() == [True, False, True]
    assert (every.detach() != 0).tolist() == [True, True, True]
