"""What a caller may have set for the whole process or thread, and the code of hqgs was not written for."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

import numpy as np


@contextmanager
def own_state(grad: bool | None = None) -> Iterator[None]:
    """Within it the state is that of a fresh process; what the caller had is put back. Also a decorator.

    `grad`: whether gradients are recorded, and tensors are none of inference; None: as the caller has it.
    """
    with ExitStack() as stack:
        torch = sys.modules.get("torch")  # where it is not loaded, nobody has set anything
        for odd in [] if torch is None else _odd(torch, grad):
            stack.enter_context(odd)
        stack.enter_context(np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"))
        if any(action == "error" for action, *_ in warnings.filters):
            stack.enter_context(warnings.catch_warnings())
            warnings.simplefilter("default")
        yield


def _odd(torch: Any, grad: bool | None) -> Iterator[AbstractContextManager[object]]:
    """What puts the state of torch right, each where it is not."""
    if torch.get_default_dtype() != torch.float32:
        yield _set_back(torch.set_default_dtype, torch.float32, torch.get_default_dtype())
    if torch.get_default_device().type != "cpu":
        yield torch.device("cpu")
    if torch.are_deterministic_algorithms_enabled():  # refuses operations that have no such variant
        mode = "warn" if torch.is_deterministic_algorithms_warn_only_enabled() else "error"
        yield _set_back(torch.set_deterministic_debug_mode, "default", mode)
    if torch.is_autocast_enabled("cpu"):
        yield torch.autocast("cpu", enabled=False)
    if grad is not None and torch.is_inference_mode_enabled():
        yield torch.inference_mode(False)
    if grad is not None and torch.is_grad_enabled() != grad:
        yield torch.set_grad_enabled(grad)


@contextmanager
def _set_back(setter: Any, value: object, before: object) -> Iterator[None]:
    setter(value)
    try:
        yield
    finally:
        setter(before)
