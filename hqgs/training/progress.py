"""What a run tells while it trains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hqgs.diagnosis.scene import Diagnosis
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.records import HistoryEntry
from hqgs.model.gaussians import Gaussians
from hqgs.training.forward import Step
from hqgs.training.trainer import Trainer


@dataclass(frozen=True)
class Progress:
    """What a run has just done: one step."""

    iteration: int  # steps done, those before a `resume` among them
    length: int  # steps of the whole run, as far as it is known; it may get less
    seconds: float  # of training so far
    gaussians: int
    loss: float
    view: str  # the training view of the step
    render: NDArray[np.float32]  # of that view, [H, W, 3], not clamped; may be smaller than the photo
    evaluated: HistoryEntry | None  # where the held-out views were measured after this step
    diagnosis: Diagnosis | None = field(repr=False)  # of the photos; None: the method asked for none
    _step: Step = field(repr=False)
    _trainer: Trainer = field(repr=False)

    def model(self) -> Gaussians:
        """The scene as it is rasterized now; its memory changes with the next step."""
        return self._trainer.model()

    def left(self) -> float:
        """Seconds that the rest of the steps will take, about."""
        return self._trainer.seconds_left()

    def psnr(self) -> float | None:
        """Of the render against the training photo, dB. None where it is infinite or nothing counts."""
        step = self._step
        return psnr(self.render, step.view.image, step.view.mask)


OnProgress = Callable[[Progress], None]
