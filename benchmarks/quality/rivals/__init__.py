"""Methods of others that the quality benchmark compares with, each in the smallest honest form."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.measure import Training
from benchmarks.protocol import Row
from benchmarks.quality.rivals.deblur import train_deblur
from benchmarks.quality.rivals.nerf import NerfTraining
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig

RIVALS: dict[str, Callable[[Scene, TrainConfig], Training | NerfTraining]] = {
    "deblur": train_deblur,
    "nerf": NerfTraining,
}


@dataclass(frozen=True)
class RivalRow(Row):
    """A row that may be one of the rivals; its configuration then is that of 3dgs."""

    rival: Literal["", "deblur", "nerf"] = ""

    @property
    def more(self) -> dict[str, Any]:
        """Runs of another form of the rival do not count: its file is no part of `sources`."""
        if not self.rival:
            return super().more
        text = Path(__file__).with_name(f"{self.rival}.py").read_bytes()
        return super().more | {"rival": self.rival, "form": hashlib.sha256(text).hexdigest()[:8]}
