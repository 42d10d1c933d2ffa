"""Adam on the CPU, in place and in parallel, with the formulas and the state of `torch.optim.Adam`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.graph import increment_version
from torch.optim.optimizer import ParamsT

from hqgs import _rust

UNSUPPORTED = (
    "weight_decay",
    "amsgrad",
    "maximize",
    "differentiable",
)  # a loaded state dict may ask for these


class Adam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015) as `torch.optim.Adam` with its defaults; state `step, exp_avg, exp_avg_sq`.

    Parameters are contiguous CPU tensors, float32 or float64. Same bits for any number of threads.

    Args:
        params: tensors, or groups of them, each with its own `lr`, `betas` or `eps`.
        lr: learning rate; may be changed in `param_groups` between steps.
        betas: decay of the two moments, in [0, 1).
        eps: added to the square root of the second moment.

    Raises:
        ValueError: in `step`, a setting out of its range, or a tensor that it cannot work on.
    """

    def __init__(
        self,
        params: ParamsT,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]  (torch's base says None)
        self, closure: Callable[[], Tensor] | None = None, visible: Tensor | None = None
    ) -> Tensor | None:
        """Update every parameter that has a gradient.

        Args:
            closure: evaluated first, with gradients enabled; its value is returned.
            visible: bool [N] for parameters [N, ...]: rows where it is False are left as they are, moments
                included (the selective Adam of Taming 3DGS, Mallick et al. 2024). None: all rows. Groups with
                `every_row` take no notice of it.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if visible is not None and visible.dtype != torch.bool:
            raise ValueError(f"visible: must be bool, got {visible.dtype}")
        rows = None if visible is None else visible.contiguous().numpy().view(np.uint8)
        for group in self.param_groups:
            if asked := [name for name in UNSUPPORTED if group.get(name)]:
                raise ValueError(f"param_groups: {asked} of torch.optim.Adam cannot be had here")
            chosen = None if group.get("every_row") else rows
            for param in group["params"]:
                if param.grad is not None:
                    self._update(param, param.grad, group, chosen)
        return loss

    def _update(
        self, param: Tensor, grad: Tensor, group: dict[str, Any], rows: np.ndarray[Any, Any] | None
    ) -> None:
        if param.device.type != "cpu" or grad.is_sparse or not param.is_contiguous():
            raise ValueError(
                "param: must be a contiguous CPU tensor with a dense gradient, got shape "
                f"{list(param.shape)}, strides {param.stride()}, {param.device}, gradient {grad.layout}"
            )
        state = self.state[param]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(param)
            state["exp_avg_sq"] = torch.zeros_like(param)
        moments = state["exp_avg"], state["exp_avg_sq"]
        values, first, second = (t.detach().numpy() for t in (param, *moments))
        beta1, beta2 = group["betas"]
        options = (float(group["lr"]), beta1, beta2, group["eps"])
        step = state["step"] + 1
        _rust.adam_step(values, grad.contiguous().numpy(), first, second, int(step), options, rows)
        state["step"] = step  # a new tensor: a loaded state dict may share the old one
        for tensor in (param, *moments):
            increment_version(tensor)  # written behind torch's back
