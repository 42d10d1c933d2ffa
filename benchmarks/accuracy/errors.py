"""Errors of a pass against a more exact one, and which passes no other one beats in both error and time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

IMAGE = "image"


def errors_against(outputs: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, Any]:
    """Image and gradients against `exact`; both hold "image" and the gradients by name, float64.

    The image: largest and root-mean-square error, and PSNR in dB where white is 1 (None: no error). Each
    gradient, and "all" of them as one vector: |g - exact| / |exact|, and the cosine of the angle between the
    two (None: one of them is 0).
    """
    difference = outputs[IMAGE] - exact[IMAGE]
    rms = float(difference.square().mean().sqrt())
    names = [name for name in exact if name != IMAGE]
    gradients = {name: _direction(outputs[name].flatten(), exact[name].flatten()) for name in names}
    both = [torch.cat([side[name].flatten() for name in names]) for side in (outputs, exact)]
    psnr = -20 * math.log10(rms) if rms > 0 else None
    return {
        IMAGE: {"max": float(difference.abs().max()), "rms": rms, "psnr": psnr},
        "gradients": gradients | {"all": _direction(*both)},
    }


def _direction(found: Tensor, exact: Tensor) -> dict[str, float | None]:
    length, other = float(exact.norm()), float(found.norm())
    if length == 0 or other == 0:
        return {"relative": None, "cosine": None}
    cosine = float(found @ exact) / (length * other)
    return {"relative": float((found - exact).norm()) / length, "cosine": min(1.0, cosine)}


def pareto_front(times: Sequence[float], errors: Sequence[float]) -> list[int]:
    """The indices of the points that no other one beats in time and error, by rising time."""
    front: list[int] = []
    for i in sorted(range(len(times)), key=lambda k: (times[k], errors[k])):
        if not front or errors[i] < errors[front[-1]]:
            front.append(i)
    return front
