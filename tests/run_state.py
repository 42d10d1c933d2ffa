"""The whole state of a run, for comparing runs bit by bit."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

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
