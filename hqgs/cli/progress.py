"""What the screen shows while a run trains."""

from __future__ import annotations

import math
import sys
from types import TracebackType
from typing import TYPE_CHECKING, NoReturn

from tqdm import tqdm

if TYPE_CHECKING:
    from hqgs.training.progress import Progress

_NUMBERS_EVERY = 10  # steps between updates of the numbers beside the bar


class ProgressBar:
    """A bar on a terminal, with a smoothed PSNR of the training views; a line for each evaluation."""

    def __init__(self) -> None:
        self._bar: tqdm[NoReturn] | None = None
        self._psnr: float | None = None

    def __call__(self, now: Progress) -> None:
        """Show a step."""
        bar = self._bar
        if bar is None:
            bar = self._bar = tqdm(total=now.length, initial=now.iteration - 1, disable=None)
        if not bar.disable and now.iteration % _NUMBERS_EVERY == 0:
            bar.set_postfix_str(self._numbers(now), refresh=False)
        bar.total = now.length
        bar.update()
        if now.evaluated is not None:
            bar.write(_evaluated(now), file=sys.stderr)

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def _numbers(self, now: Progress) -> str:
        if math.isfinite(now.loss) and (psnr := now.psnr()) is not None:
            self._psnr = psnr if self._psnr is None else 0.9 * self._psnr + 0.1 * psnr
        shown = "-" if self._psnr is None else f"{self._psnr:.2f} dB"
        return f"loss {now.loss:.4f}, PSNR {shown}, {now.gaussians} Gaussians"


def _evaluated(now: Progress) -> str:
    means = now.evaluated or {"psnr": None, "ssim": None}
    values = ["no PSNR" if means["psnr"] is None else f"{means['psnr']:.2f} dB"]
    values += [] if means["ssim"] is None else [f"SSIM {means['ssim']:.4f}"]
    where = f"iteration {now.iteration}: {now.gaussians} Gaussians, {now.seconds:.0f} s"
    return f"{where}, held-out views {', '.join(values)}"
