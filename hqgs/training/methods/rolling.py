"""How each photo's camera moved while its rows were read one after another, learned with the scene.

The render is warped band by band, each by its place on a trajectory that runs from the first row to the last;
its mean is the photo's pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hqgs.scene.scene import Camera, View
from hqgs.training.constants import (
    BAND_SPACING,
    CAMERA_RATES_LEFT,
    FEWEST_BANDS,
    MOST_BANDS,
    NARROW,
    TRAJECTORY_POINTS,
    TRAJECTORY_RATE,
)
from hqgs.training.methods.trajectory import longest, middle_of, moved_by, trajectory_warps


class LearnedRolling:
    """Of a scene's training photos. They begin still: what shared points tell before
    (`hqgs.diagnosis.rolling`) lacks what all photos have in common; runs from there end 0.7 dB lower."""

    def __init__(self, views: Sequence[View]) -> None:
        self._width = float(np.mean([max(view.camera.width, NARROW) for view in views]))
        self._paths = [torch.zeros(2, 6, dtype=torch.float64).requires_grad_() for _ in views]

    def rows(self, number: int, camera: Camera) -> Tensor:
        """The warps of equal bands of rows from top to bottom, as many as the photo needs, [B, 3, 4]."""
        path = self._paths[number]
        with torch.no_grad():
            whole = trajectory_warps(path, camera, TRAJECTORY_POINTS)
            moved = moved_by(whole, camera, nearness=1.0)
            extent = max(longest(moved[:, k]) for k in range(moved.shape[1]))
        count = min(max(math.ceil(extent / BAND_SPACING) + 1, FEWEST_BANDS), MOST_BANDS)
        return trajectory_warps(path, camera, count)

    def learned(self, number: int) -> NDArray[np.float64]:
        """How far the middle of a photo's picture slides from its first row to its last, [2], px."""
        middle = middle_of(self._paths[number]).numpy()
        return (middle[0] - middle[-1]) * TRAJECTORY_POINTS / (TRAJECTORY_POINTS - 1)

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "rolling", "params": self._paths, "lr": 0.0, "betas": (0.9, 0.99)}]

    def rates(self, part: float) -> dict[str, float]:
        """Learning rates after this part of the run."""
        return {"rolling": TRAJECTORY_RATE * self._width * CAMERA_RATES_LEFT**part}

    def state_dict(self) -> dict[str, Tensor]:
        return {f"rolling.{k}": path.detach() for k, path in enumerate(self._paths)}

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        for k, path in enumerate(self._paths):
            path.copy_(state[f"rolling.{k}"])
