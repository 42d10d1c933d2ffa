"""What the screen shows while something takes long: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import TaskID

    from hqgs.base.stages import Stage
    from hqgs.training.progress import Progress

_NUMBERS_EVERY = 10  # steps between updates of the bar
_SILENT = 5.0  # s without a line before a run trains, where there is no terminal
_TOLD_EVERY = 60.0  # s between lines of the training without a terminal
_WARM_UP, _MEASURED = 5, 30  # steps: before any are timed, and until the time that is left is told,
_SOON = 5.0  # s of steps after which it is told in any case
_SLOWER = 3.0  # times as long a step may take when the scene has grown
Self = TypeVar("Self", bound="Screen")


class Screen:
    """Bars on stderr; nothing is left of them when it closes."""

    def __init__(self) -> None:
        from rich.console import Console  # here: --help waits for neither
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        self.console: Console = Console(stderr=True, highlight=False, soft_wrap=True)
        self.live: bool = self.console.is_terminal
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[more]}"),
        )
        self._bars = Bars(*columns, console=self.console, transient=True, disable=not self.live)
        self._task: TaskID | None = None
        self._said = time.perf_counter()

    def __enter__(self: Self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """A line that stays."""
        self._said = time.perf_counter()
        self.console.print(text, markup=False)

    def stage(self, stage: Stage) -> None:
        """Where the work before the first step is; a note stays."""
        if stage.note:
            self.say(stage.note)
            return
        self.show(stage.what, stage.done, stage.total)
        if not self.live and time.perf_counter() - self._said > _SILENT:
            count = f": {stage.done}" if stage.done else ""
            self.say(f"{stage.what}{count}" + (f" of {stage.total}" if count and stage.total else ""))

    def show(self, what: str, done: int, total: int, more: str = "") -> None:
        """Where the work is; other words begin another bar."""
        if self._task is None or self._bars.tasks[-1].description != what:
            if self._task is not None:
                self._bars.remove_task(self._task)
            self._task = self._bars.add_task(what, total=total or None, more=more)
        self._bars.update(self._task, completed=done, total=total or None, more=more)


class LoadingScreen(Screen):
    """What happens until a scene is loaded; `seconds` tells how long each stage took."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def stage(self, stage: Stage) -> None:
        now = time.perf_counter()
        self.seconds[stage.what] = self.seconds.get(stage.what, 0.0) + now - self._since
        self._since = now
        super().stage(stage)

    @property
    def colmap_seconds(self) -> float:
        """Of all stages of COLMAP."""
        return sum(seconds for what, seconds in self.seconds.items() if what.startswith("COLMAP"))


class TrainingScreen(Screen):
    """The run: iterations, held-out error, Gaussians, time left; a line for each evaluation."""

    def __init__(self) -> None:
        super().__init__()
        self._held_out = "not measured yet"
        self._first: tuple[int, float] | None = None  # iteration and seconds from which on steps are timed
        self._told = False
        self._mark: tuple[float, int, float] | None = None  # of the last line: when, iteration, s of training
        self.began: float | None = None  # `time.perf_counter` after the first step
        self.ended: float | None = None  # and after the last one

    def __call__(self, now: Progress) -> None:
        """Show a step."""
        self.ended = time.perf_counter()
        self.began = self.began or self.ended
        if now.evaluated is not None:
            psnr = now.evaluated["psnr"]
            self._held_out = "no PSNR" if psnr is None else f"{psnr:.2f} dB"
            self.say(_evaluated(now) + self._left(now))
        elif self._mark is None:
            self._mark = self.ended, now.iteration, now.seconds
        elif not self.live and self.ended - self._mark[0] > _TOLD_EVERY:
            numbers = f"{now.gaussians} Gaussians, {now.seconds:.0f} s, loss {now.loss:.3f}"
            self.say(f"iteration {now.iteration} of {now.length}: {numbers}{self._left(now)}")
        if now.iteration % _NUMBERS_EVERY == 0 or now.evaluated is not None:
            more = f"held-out {self._held_out}, {now.gaussians:,} Gaussians, loss {now.loss:.3f}"
            self.show("training", now.iteration, now.length, more)
        self._estimate(now)

    def _left(self, now: Progress) -> str:
        """The time that is left, from the steps since the last line."""
        mark, self._mark = self._mark, (self.ended or 0.0, now.iteration, now.seconds)
        if mark is None or now.iteration in (mark[1], now.length):
            return ""
        step = (now.seconds - mark[2]) / (now.iteration - mark[1])
        return f"; about {duration(step * (now.length - now.iteration))} left"

    def _estimate(self, now: Progress) -> None:
        """Once, in the first seconds: how long the run will take here."""
        if self._told:
            return
        if self._first is None:
            self._first = now.iteration + _WARM_UP, 0.0
        start, seconds = self._first
        if not seconds and now.iteration >= start:
            self._first = now.iteration, now.seconds
        elif now.iteration >= start + _MEASURED or (now.iteration > start and now.seconds - seconds >= _SOON):
            self._told = True
            step, left = (now.seconds - seconds) / (now.iteration - start), now.length - now.iteration
            self.say(
                f"{now.length:,} iterations, {1 / step:.1f} per second now: training takes about "
                f"{duration(left * step)} to {duration(_SLOWER * left * step)} (steps slow down as Gaussians "
                "are added), plus evaluations. Ctrl-C stops at any time and writes the scene"
            )


def duration(seconds: float) -> str:
    """For people: 40 s, 3 min, 2.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _evaluated(now: Progress) -> str:
    means = now.evaluated
    assert means is not None  # or it is not called
    values = ["no PSNR" if means["psnr"] is None else f"{means['psnr']:.2f} dB"]
    values += [] if means["ssim"] is None else [f"SSIM {means['ssim']:.4f}"]
    where = f"iteration {now.iteration}: {now.gaussians} Gaussians, {now.seconds:.0f} s"
    which = f"{means['views']} of the held-out views" if "views" in means else "held-out views"
    return f"{where}, {which} {', '.join(values)}"


@dataclass(frozen=True)
class Times:
    """When the parts of a command began, s."""

    start: float
    loaded: float
    trained_from: float
    trained_to: float
    end: float

    def told(self, colmap: float) -> str:
        """How long each part took; `colmap`: s, of the loading."""
        of_it = f" (COLMAP {duration(colmap)})" if colmap >= 1 else ""
        return (
            f"{duration(self.end - self.start)}: loading {duration(self.loaded - self.start)}{of_it}, "
            f"preparing {duration(self.trained_from - self.loaded)}, "
            f"training {duration(self.trained_to - self.trained_from)}, "
            f"report {duration(self.end - self.trained_to)}"
        )
