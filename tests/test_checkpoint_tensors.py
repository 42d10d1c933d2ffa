"""A checkpoint with one tensor of another shape is refused, and the tensor is named."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

from hqgs.training.checkpoint import load_checkpoint, save_checkpoint
from hqgs.training.trainer import Trainer

Saved = tuple[dict[str, Tensor], dict[str, object]]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Saved:
    """Of a run of three steps."""
    trainer = Trainer(tiny_scene(), tiny_config())
    for _ in range(3):
        trainer.step()
    path = tmp_path_factory.mktemp("saved") / "c.safetensors"
    trainer.save(path)
    return load_checkpoint(path)


@pytest.mark.parametrize(
    "name", ["gaussians.sh0", "adam.means.0.exp_avg", "adam.quats.0.exp_avg_sq", "densify.count"]
)
def test_a_tensor_that_does_not_fit_is_named(name: str, saved: Saved, tmp_path: Path) -> None:
    tensors, meta = saved
    path = tmp_path / "c.safetensors"
    for wrong in (tensors[name][:-1].clone(), tensors[name].to(torch.float64)):
        save_checkpoint(path, tensors | {name: wrong}, meta)
        with pytest.raises(ValueError, match=name.removeprefix("gaussians.").replace(".", r"\.")):
            Trainer(tiny_scene(), tiny_config()).restore(path)
    save_checkpoint(path, tensors, meta)
    whole = Trainer(tiny_scene(), tiny_config())
    whole.restore(path)
    assert whole.iteration == 3
