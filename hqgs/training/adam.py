"""Adam on the CPU, in place and in parallel, with the formulas and the state of `torch.optim.Adam`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version
from torch.optim import Optimizer
from torch.optim.optimizer import ParamsT

from hqgs import _rust
from hqgs.model.gaussians import Gaussians


class Adam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) as `torch.optim.Adam` with its defaults; state `step, exp_avg, exp_avg_sq`.

    Parameters are contiguous CPU tensors, float32 or float64. Same bits for any number of threads.

    Args:
        params: tensors, or groups of them, each with its own `lr`, `betas` or `eps`. A group of tensors
            [N, K, ...] may have `used`: only the first so many of the K are updated. For those that never had
            a gradient that is the same, bit for bit; the step still counts.
        lr: learning rate; may be changed in `param_groups` between steps, and so may `used`.
        betas: decay of the two moments, in [0, 1).
        eps: added to the square root of the second moment.

    Raises:
        ValueError: in `step`, a setting out of its range, or a tensor that it cannot work on.
    """

    def __init__(
        self, params: ParamsT, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    # torch wraps these four so that its compiler leaves them alone, and loads it for that: 4 s of a start.

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        inspect.unwrap(Optimizer.add_param_group)(self, param_group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        if not set_to_none:
            return inspect.unwrap(Optimizer.zero_grad)(self, set_to_none)
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    def state_dict(self) -> dict[str, Any]:
        return inspect.unwrap(Optimizer.state_dict)(self)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        inspect.unwrap(Optimizer.load_state_dict)(self, state_dict)

    @torch.no_grad()
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's base says None)
        self, closure: Callable[[], Tensor] | None = None, views: Mapping[Tensor, int] | None = None
    ) -> Tensor | None:
        """Update every parameter that has a gradient.

        Args:
            closure: evaluated first, with gradients enabled; its value is returned.
            views: of how many views a parameter's gradient is the mean, where not of one. With n the rate is
                sqrt(n) times as high and the moments decay by betas^n, as in Grendel (arXiv 2406.18533).
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        counts = views or {}
        writes, changed = list[tuple[Any, ...]](), list[Tensor]()
        steps = list[tuple[dict[str, Any], Tensor]]()
        for group in self.param_groups:
            others = ("weight_decay", "amsgrad", "maximize", "differentiable")
            if asked := [name for name in others if group.get(name)]:
                raise ValueError(f"param_groups: {asked} of torch.optim.Adam cannot be had here")
            used = group.get("used")
            for param in group["params"]:
                if param.grad is None and used != 0:
                    continue
                state = self._state_of(param)
                steps.append((state, state["step"] + 1))
                if used != 0:
                    moments = state["exp_avg"], state["exp_avg_sq"]
                    step, count = int(steps[-1][1]), counts.get(param, 1)
                    writes.append(_write(param, *moments, step, group, count))
                    changed += param, *moments
        _rust.adam_steps(writes)
        for tensor in changed:  # written behind torch's back; torch 2.5 takes one at a time
            increment_version(tensor)
        for state, step in steps:
            state["step"] = step  # a new tensor: a loaded state dict may share the old one
        return loss

    def _state_of(self, param: Tensor) -> dict[str, Any]:
        state = self.state[param]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(param)
            state["exp_avg_sq"] = torch.zeros_like(param)
        return state


def _write(
    param: Tensor, first: Tensor, second: Tensor, step: int, group: dict[str, Any], views: int
) -> tuple[Any, ...]:
    """What `_rust.adam_steps` is to do."""
    grad = param.grad
    assert grad is not None
    if param.device.type != "cpu" or grad.is_sparse or not param.is_contiguous():
        raise ValueError(
            "param: must be a contiguous CPU tensor with a dense gradient, got shape "
            f"{list(param.shape)}, strides {param.stride()}, {param.device}, gradient {grad.layout}"
        )
    values, grad = param.detach().numpy(), grad.contiguous().numpy()
    beta1, beta2 = group["betas"]
    options = (float(group["lr"]) * math.sqrt(views), beta1**views, beta2**views, group["eps"])
    return values, grad, first.numpy(), second.numpy(), step, options, group.get("used")


def select_rows(gaussians: Gaussians, optimizer: Optimizer, rows: Tensor, old: int) -> None:
    """Make row i of every tensor the former row `rows[i]`, in the parameters and in the optimizer's state.

    Rows up to `old` keep their moments. Those after it are new Gaussians: their moments start at zero.
    """
    for name, tensor in gaussians.named().items():
        chosen = tensor.detach()[rows].requires_grad_()
        state = {}
        for key, value in optimizer.state.pop(tensor, {}).items():
            if isinstance(value, Tensor) and value.shape == tensor.shape:
                value = value[rows]
                value[old:] = 0
            state[key] = value
        _replace(gaussians, optimizer, name, chosen, state)


def reset_opacities(gaussians: Gaussians, optimizer: Optimizer, highest: float) -> None:
    """Cut the opacities to `highest` and forget the moments that led to them."""
    old = gaussians.opacities
    logit = math.log(highest / (1 - highest))
    state = {
        key: torch.zeros_like(value) if isinstance(value, Tensor) and value.shape == old.shape else value
        for key, value in optimizer.state.pop(old, {}).items()
    }
    _replace(gaussians, optimizer, "opacities", old.detach().clamp(max=logit).requires_grad_(), state)


def _replace(
    gaussians: Gaussians, optimizer: Optimizer, name: str, tensor: Tensor, state: dict[str, Any]
) -> None:
    """Put a new leaf in the place of an old one: in the Gaussians, in its parameter group, in the state."""
    old = getattr(gaussians, name)
    group = next(g for g in optimizer.param_groups if any(p is old for p in g["params"]))
    group["params"] = [tensor if p is old else p for p in group["params"]]
    if state:
        optimizer.state[tensor] = state
    setattr(gaussians, name, tensor)
