"""Checkpoints: resumed runs equal uninterrupted ones bit for bit; another run and damage are noticed."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from planned import run_config
from run_state import assert_stopped_alike
from tiny_scene import tiny_config, tiny_scene

from hqgs.base.files import CHECKPOINT
from hqgs.pipeline import open_run, train
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import OTHER, check_scene, load_checkpoint, save_checkpoint, scene_fingerprint
from hqgs.training.config import DensifyConfig
from hqgs.training.trainer import Trainer, fit_to_seconds


def test_a_resumed_run_is_the_same_run(tmp_path: Path) -> None:
    """With growth at 8, 16 and 24, resets at 12 and 24."""
    scene = tiny_scene(num_points=300)
    stops = (0, 1, 8, 11, 12, 16, 23, 29)
    whole = assert_stopped_alike(lambda: Trainer(scene, tiny_config()), tmp_path, *stops)
    assert len(whole.gaussians) > 300


def test_a_fresh_run_does_not_take_up_an_older_one(tmp_path: Path) -> None:
    train(tiny_scene(), config=tiny_config(), out=tmp_path)
    with open_run(tiny_scene(), tiny_config(), tmp_path) as trainer:
        assert trainer.iteration == 0
    with open_run(tiny_scene(), tiny_config(), tmp_path, resume=True) as trainer:
        assert trainer.iteration == 0


def test_resuming_a_finished_run_changes_nothing(tmp_path: Path) -> None:
    first = train(tiny_scene(), config=tiny_config(), out=tmp_path)
    ply = (tmp_path / "scene.ply").read_bytes()
    again = train(tiny_scene(), config=tiny_config(), out=tmp_path, resume=True)
    assert (again.iterations, again.seconds, again.history) == (30, first.seconds, first.history)
    assert (tmp_path / "scene.ply").read_bytes() == ply


def saved(tmp_path: Path) -> Path:
    trainer = Trainer(tiny_scene(), tiny_config())
    trainer.step()
    trainer.save(tmp_path / CHECKPOINT)
    return tmp_path / CHECKPOINT


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 4}, "another seed: 0 there, 4 in this run"),
        ({"iterations": 31}, "another iterations: 30 there, 31 in this run"),
        ({"background": (1.0, 1.0, 1.0)}, r"another background: \[0.0, 0.0, 0.0\] there"),
        ({"densify": DensifyConfig(start=6)}, "another densify.start: 5 there, 6 in this run"),
    ],
)
def test_another_configuration_is_refused_by_field(tmp_path: Path, changes: dict, message: str) -> None:
    path = saved(tmp_path)
    with pytest.raises(ValueError, match=f"{path.name} was made with {message}"):
        Trainer(tiny_scene(), replace(tiny_config(), **changes)).restore(path)


def test_how_often_it_is_saved_may_change(tmp_path: Path) -> None:
    path = saved(tmp_path)
    trainer = Trainer(tiny_scene(), replace(tiny_config(), checkpoint_every=7, eval_every=9))
    trainer.restore(path)
    assert trainer.iteration == 1
    assert (trainer.config.checkpoint_every, trainer.config.eval_every) == (7, 9)


def test_how_often_a_run_of_seconds_is_saved_stays_as_it_was_planned(tmp_path: Path) -> None:
    trainer = Trainer(tiny_scene(), replace(run_config(method="3dgs"), seconds=1e-3))
    fit_to_seconds(trainer)
    trainer.save(tmp_path / CHECKPOINT)
    again = Trainer(tiny_scene(), trainer.asked)
    assert again.config.due.eval_every != trainer.config.due.eval_every  # no step was timed
    again.restore(tmp_path / CHECKPOINT)
    assert again.config == trainer.config


def test_another_scene_is_refused_by_field(tmp_path: Path) -> None:
    path = saved(tmp_path)
    s = tiny_scene()
    image = s.train[2].image.copy()
    image[3, 4, 1] ^= 1
    v = s.train[2]
    photos = [*s.train[:2], View(v.name, v.camera, image), *s.train[3:]]
    viewmat = v.camera.viewmat.copy()
    viewmat[0, 3] += 1e-6
    moved = [*s.train[:2], View(v.name, replace(v.camera, viewmat=viewmat), v.image), *s.train[3:]]
    masked = [replace(s.train[0], mask=np.ones((16, 24), dtype=bool)), *s.train[1:]]
    others = {
        "photos": Scene(s.name, photos, s.test, s.points, s.point_colors, s.source),
        "cameras": Scene(s.name, moved, s.test, s.points, s.point_colors, s.source),
        "masks": Scene(s.name, masked, s.test, s.points, s.point_colors, s.source),
        "points": Scene(s.name, s.train, s.test, s.points + 1e-6, s.point_colors, s.source),
        "views": Scene(s.name, s.train + s.test, [], s.points, s.point_colors, s.source),
    }
    for field, scene in others.items():
        with pytest.raises(ValueError, match=f"another scene: {re.escape(OTHER[field])}; ask for the same"):
            Trainer(scene, tiny_config()).restore(path)


def test_a_scene_is_the_same_on_another_cpu() -> None:
    """Poses come out of a singular value decomposition, which rounds as the CPU's instructions do."""
    scene = tiny_scene()

    def rounded(view: View) -> View:
        viewmat = view.camera.viewmat * (1 + 1e-15)
        viewmat[viewmat == 0] = -1e-17
        return replace(view, camera=replace(view.camera, viewmat=viewmat))

    other = replace(scene, train=[rounded(view) for view in scene.train])
    assert not np.array_equal(other.train[0].camera.viewmat, scene.train[0].camera.viewmat)
    assert scene_fingerprint(other) == scene_fingerprint(scene)


def test_tensors_and_values_round_trip(tmp_path: Path) -> None:
    tensors = {
        "float": torch.tensor([[1e-42, -0.0], [torch.inf, torch.nan]]),
        "transposed": torch.arange(6).reshape(2, 3).T,
        "scalar": torch.tensor(3.0),
        "bytes": torch.tensor([0, 255], dtype=torch.uint8),
        "empty": torch.zeros(0, 3),
    }
    meta = {"a": 0.1 + 0.2, "b": [1, None, "ü"], "c": {"d": True}}
    save_checkpoint(tmp_path / "a.safetensors", tensors, meta)
    back, values = load_checkpoint(tmp_path / "a.safetensors")
    assert values == meta
    for name, tensor in tensors.items():
        assert back[name].dtype == tensor.dtype
        assert back[name].shape == tensor.shape
        assert back[name].numpy().tobytes() == tensor.contiguous().numpy().tobytes()


def test_any_changed_byte_and_any_cut_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, {"a": torch.arange(10), "b": torch.ones(3)}, {"iteration": 3})
    whole = path.read_bytes()
    for i in range(len(whole)):
        damaged = bytearray(whole)
        damaged[i] ^= 0x04
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.safetensors"):
            load_checkpoint(path)
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.safetensors"):
            load_checkpoint(path)


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint .*a\.safetensors"):
        load_checkpoint(tmp_path / "a.safetensors")


def test_a_scene_that_lacks_what_the_saved_one_had_is_another_scene(tmp_path: Path) -> None:
    """Not only what the present scene has is compared."""
    scene = tiny_scene()
    saved = scene_fingerprint(scene)
    check_scene(tmp_path, saved, scene)
    with pytest.raises(ValueError, match="is of another scene: it had surroundings"):
        check_scene(tmp_path, saved | {"surroundings": "0123"}, scene)
