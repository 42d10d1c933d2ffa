"""What the screen shows while something takes long: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import TaskID

    from hqgs.base.stages import Stage
    from hqgs.pipeline import Progress

_MEASURED, _SOON = 35, 5.0  # steps, or s of them, after which the time that is left is told
Self = TypeVar("Self", bound="Screen")


class Screen:
    """Bars on stderr; nothing is left of them when it closes."""

    def __init__(self) -> None:
        from rich.console import Console  # here: --help waits for neither
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
        from rich.progress import Progress as Bars

        self.console: Console = Console(stderr=True, highlight=False, soft_wrap=True)
        self.live: bool = self.console.is_terminal
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[more]}"),
        )
        self._bars = Bars(*columns, console=self.console, transient=True, disable=not self.live)
        self._task: TaskID | None = None
        self._said = time.perf_counter()
        self._work: tuple[str, int, float] = "", 0, 0.0  # of a stage: what, how much was done at first, when

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
        left = self._left(stage)
        self.show(stage.what, stage.done, stage.total, left)
        if not self.live and time.perf_counter() - self._said > 5:  # s without a line
            count = f": {stage.done}" if stage.done else ""
            count += f" of {stage.total}" if count and stage.total else ""
            self.say(f"{stage.what}{count}{left and f', {left}'}")

    def _left(self, stage: Stage) -> str:
        """The time that a stage will take, by what it took so far; nothing where that is short."""
        what, first, began = self._work
        now = time.perf_counter()
        if what != stage.what or stage.done < first:
            self._work = stage.what, stage.done, now
        elif first < stage.done < stage.total and now - began > 1:
            return f"about {duration((now - began) * (stage.total - stage.done) / (stage.done - first))} left"
        return ""

    def show(self, what: str, done: int, total: int, left: str = "", more: str = "") -> None:
        """Where the work is; other words begin another bar."""
        if self._task is None or self._bars.tasks[-1].description != what:
            if self._task is not None:
                self._bars.remove_task(self._task)
            self._task = self._bars.add_task(what, total=total or None, left=left, more=more)
        self._bars.update(self._task, completed=done, total=total or None, left=left, more=more)


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
        self._steps = 0  # seen
        self.began: float | None = None  # `time.perf_counter` after the first step
        self.ended: float | None = None  # and after the last one

    def __call__(self, now: Progress) -> None:
        """Show a step."""
        self.ended = time.perf_counter()
        self.began = self.began or self.ended
        if now.evaluated is not None:
            psnr = now.evaluated["psnr"]
            self._held_out = "no PSNR" if psnr is None else f"{psnr:.2f} dB"
            self.say(_evaluated(now) + _left(now))
        elif not self.live and self.ended - self._said > 60:  # s without a line
            numbers = f"{now.gaussians} Gaussians, {now.seconds:.0f} s, loss {now.loss:.3f}"
            self.say(f"iteration {now.iteration} of {now.length}: {numbers}{_left(now)}")
        if now.iteration % 10 == 0 or now.evaluated is not None:
            more = f"held-out {self._held_out}, {now.gaussians:,} Gaussians, loss {now.loss:.3f}"
            self.show("training", now.iteration, now.length, _left(now).removeprefix("; "), more)
        before, self._steps = self._steps, self._steps + 1
        if before < _MEASURED and (self._steps == _MEASURED or self.ended - self.began > _SOON):
            self._steps = _MEASURED
            self.say(
                f"{now.length:,} iterations{_left(now)}, plus evaluations. Ctrl-C stops at any time and "
                "writes the scene"
            )


def _left(now: Progress) -> str:
    return f"; about {duration(now.left())} left" if now.iteration < now.length else ""


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


def told_times(start: float, loaded: float, bar: TrainingScreen, colmap: float) -> str:
    """How long each part of a run took until now; `colmap`: s, of the loading."""
    began, ended, end = bar.began or loaded, bar.ended or loaded, time.perf_counter()
    of_it = f" (COLMAP {duration(colmap)})" if colmap >= 1 else ""
    return (
        f"{duration(end - start)}: loading {duration(loaded - start)}{of_it}, preparing "
        f"{duration(began - loaded)}, training {duration(ended - began)}, report {duration(end - ended)}"
    )
