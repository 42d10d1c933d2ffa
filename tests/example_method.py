"""The smallest method with a tensor of its own: 3DGS with a tint of all Gaussians, trained along with them.

Written as `hqgs/training/methods/base.py` says. It would go into that folder; here its name and maker are
put in for a test.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.training.config import METHODS
from hqgs.training.methods import MAKERS
from hqgs.training.methods.base import Method, Target, ThreeDGS
from hqgs.training.methods.photometric import photometric_loss


class Tinted(ThreeDGS):
    """The loss is L1 alone."""

    name = "tinted"

    def __init__(self) -> None:
        self.tint = torch.zeros(3, requires_grad=True)

    def modulate(self, gaussians: Gaussians) -> Gaussians:
        return replace(gaussians, sh0=gaussians.sh0 + self.tint)

    def loss(self, image: Tensor, target: Target) -> Tensor:
        return photometric_loss(image, target.photo, target.mask, lambda_dssim=0.0)

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "tint", "params": [self.tint], "lr": 0.01}]

    def state_dict(self) -> dict[str, Tensor]:
        return {"tint": self.tint}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self.tint.copy_(state["tint"])


def install(monkeypatch: pytest.MonkeyPatch, name: str, make: Any) -> None:
    """For the rest of a test, `method=name` trains what `make` gives: a method, or a function of what
    `MAKERS` are called with."""
    monkeypatch.setitem(METHODS, name, "")
    monkeypatch.setitem(MAKERS, name, make if callable(make) else lambda *given: make)


def loss_of(method: Method[Any], render: Tensor, view: Any) -> Tensor:
    """The loss of a render against a view, as a step computes it."""
    target = method.prepare(view)
    return method.loss(method.compare(render, target), target)
