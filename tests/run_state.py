"""The whole state of a run, for comparing runs bit by bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import hqgs
from hqgs.training.checkpoint import load_checkpoint
from hqgs.training.trainer import Trainer

State = tuple[dict[str, Tensor], dict[str, object]]


def read_state(path: Path) -> State:
    """All tensors and values of a checkpoint but those that measure time."""
    tensors, meta = load_checkpoint(path)
    for name in ("seconds", "history"):
        del meta[name]
    return tensors, meta


def whole_state(trainer: Trainer, path: Path) -> State:
    """All tensors and values of a trainer but those that measure time."""
    trainer.save(path)
    return read_state(path)


def assert_same(a: State, b: State) -> None:
    assert a[1] == b[1]
    assert a[0].keys() == b[0].keys()
    for name, tensor in a[0].items():
        assert tensor.dtype == b[0][name].dtype, name
        assert tensor.numpy().tobytes() == b[0][name].numpy().tobytes(), name


def run_until(trainer: Trainer, end: int | None = None) -> Trainer:
    """The trainer after step `end`, or at its end."""
    while trainer.iteration < (trainer.length if end is None else end):
        trainer.step()
    return trainer


def assert_stopped_alike(make: Callable[[], Trainer], folder: Path, *stops: int) -> Trainer:
    """A run that is stopped after a step, looked at and resumed, with more threads, ends with the bits of one
    in one go, which is returned."""
    path = folder / "stopped"
    hqgs.set_num_threads(1)
    torch.set_num_threads(1)
    whole = run_until(make())
    expected = whole_state(whole, folder / "whole")
    hqgs.set_num_threads(3)
    torch.set_num_threads(2)
    for stop in stops:
        first, again = run_until(make(), stop), make()
        first.save(path)
        list(again.held_out())
        again.restore(path)
        assert (again.iteration, again.seconds) == (stop, first.seconds)
        again.save(path)  # at once, before any step
        again.restore(path)
        assert_same(whole_state(run_until(again), path), expected)
        assert torch.get_num_threads() == 2
    return whole
