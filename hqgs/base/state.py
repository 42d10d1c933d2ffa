"""What a caller may have set for the whole process or thread, and the code of hqgs was not written for."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

import numpy as np
import torch

_ERRORS = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}  # numpy's defaults


@contextmanager
def own_state(grad: bool | None = None) -> Iterator[None]:
    """Within it the state is that of a fresh process; what the caller had is put back. Also a decorator.

    `grad`: whether gradients are recorded, and tensors are none of inference; None: as the caller has it.
    """
    with ExitStack() as stack:
        for odd in _odd(grad):
            stack.enter_context(odd)
        yield


def _odd(grad: bool | None) -> Iterator[AbstractContextManager[object]]:
    """What puts the state right where it is not."""
    if torch.get_default_dtype() != torch.float32:
        yield _float32()
    if torch.get_default_device().type != "cpu":
        yield torch.device("cpu")
    if torch.are_deterministic_algorithms_enabled():
        yield _not_deterministic()
    if torch.is_autocast_enabled("cpu"):
        yield torch.autocast("cpu", enabled=False)
    if grad is not None and torch.is_inference_mode_enabled():
        yield torch.inference_mode(False)
    if grad is not None and torch.is_grad_enabled() != grad:
        yield torch.set_grad_enabled(grad)
    if np.geterr() != _ERRORS:
        yield np.errstate(**_ERRORS)  # pyright: ignore[reportArgumentType]
    if any(action == "error" for action, *_ in warnings.filters):
        yield _warnings_are_no_errors()


@contextmanager
def _float32() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def _not_deterministic() -> Iterator[None]:
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(False)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(True, warn_only=warn_only)


@contextmanager
def _warnings_are_no_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        yield
