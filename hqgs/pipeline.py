"""A training run in a folder: progress, checkpoints, Ctrl-C, and the files at the end."""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from hqgs.base.files import CHECKPOINT, PLY, lock_folder, remove_leftovers
from hqgs.base.left_out import LeftOut
from hqgs.base.machine import peak_rss_mb
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.report import RunResult, write_report
from hqgs.export.ply import write_ply
from hqgs.scene.scene import Scene
from hqgs.training.config import TrainConfig
from hqgs.training.trainer import Step, Trainer

ENDINGS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and what batch systems send
BAR_EVERY = 10  # steps between updates of the numbers in the progress bar


def train(
    scene: Scene, config: TrainConfig, out: str | Path, resume: bool = False, progress: bool = True
) -> RunResult:
    """Train a scene and write checkpoint.safetensors, scene.ply and the files of `write_report` into `out`.

    The first Ctrl-C ends the run after the step it is in: everything is written, and
    `RunResult.iterations` tells how far it came. See `open_run` for `resume` and the errors.
    """
    with open_run(scene, config, out, resume) as trainer:
        return run(trainer, out, progress)


@contextmanager
def open_run(scene: Scene, config: TrainConfig, out: str | Path, resume: bool = False) -> Iterator[Trainer]:
    """A trainer that holds the folder `out`: fresh, or with `resume` where the checkpoint there ends.

    Without a checkpoint `resume` starts fresh (the run may have been killed before its first one). A fresh
    run removes an older checkpoint.

    Raises:
        ValueError: a scene that cannot be trained, a damaged checkpoint, or one of another run.
        FolderBusyError: another run holds the folder.
    """
    checkpoint = Path(out) / CHECKPOINT
    with lock_folder(out):
        for file in (CHECKPOINT, PLY):
            remove_leftovers(Path(out) / file)
        trainer = Trainer(scene, config)
        if not resume:
            checkpoint.unlink(missing_ok=True)
        elif checkpoint.exists():
            trainer.restore(checkpoint)
        yield trainer


def run(trainer: Trainer, out: str | Path, progress: bool = True) -> RunResult:
    """Train to the end or to the first Ctrl-C and write everything into `out`, which the caller holds.

    A second Ctrl-C raises KeyboardInterrupt at once and leaves the files as they were last written.
    """
    out = Path(out)
    config = trainer.config
    bar = tqdm(total=trainer.length, initial=trainer.iteration, disable=None if progress else True)
    numbers = _BarNumbers()
    with deferred_interrupt() as interrupted, bar:
        while trainer.iteration < trainer.length and not interrupted.is_set():
            step = trainer.step()
            if not bar.disable and trainer.iteration % BAR_EVERY == 0:
                bar.set_postfix_str(numbers.text(step, len(trainer.gaussians)), refresh=False)
            bar.total = trainer.length  # which may have become less
            bar.update()
            if trainer.iteration % config.eval_every == 0:
                trainer.evaluate()
                if progress:
                    bar.write(_progress_line(trainer), file=sys.stderr)
            if trainer.iteration % config.checkpoint_every == 0:
                trainer.save(out / CHECKPOINT)
        trainer.evaluate()
        trainer.save(out / CHECKPOINT)
        return _write_results(trainer, out)


@contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """Within this, the first Ctrl-C sets the event that it yields, the second raises KeyboardInterrupt.

    So does SIGTERM.
    """
    requested = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield requested  # signals only reach the main thread
        return

    def on_interrupt(number: int, frame: object) -> None:
        requested.set()
        for ending in ENDINGS:
            signal.signal(ending, signal.default_int_handler)

    before = {ending: signal.signal(ending, on_interrupt) for ending in ENDINGS}
    try:
        yield requested
    finally:
        for ending, handler in before.items():
            # None: it was not set from Python. pycolmap's prints a stack trace, which nobody asked for.
            signal.signal(ending, signal.SIG_DFL if handler is None else handler)


class _BarNumbers:
    """The numbers beside the bar, with a smoothed PSNR of the training views."""

    def __init__(self) -> None:
        self.psnr: float | None = None

    def text(self, step: Step, gaussians: int) -> str:
        if math.isfinite(step.loss):
            now = psnr(step.render.numpy(), step.view.image, step.view.mask)
            if now is not None:
                self.psnr = now if self.psnr is None else 0.9 * self.psnr + 0.1 * now
        shown = "-" if self.psnr is None else f"{self.psnr:.2f} dB"
        return f"loss {step.loss:.4f}, PSNR {shown}, {gaussians} Gaussians"


def _progress_line(trainer: Trainer) -> str:
    last = trainer.history[-1]
    values = ["no PSNR" if last["psnr"] is None else f"{last['psnr']:.2f} dB"]
    values += [] if last["ssim"] is None else [f"SSIM {last['ssim']:.4f}"]
    where = f"iteration {trainer.iteration}: {len(trainer.gaussians)} Gaussians, {trainer.seconds:.0f} s"
    return f"{where}, held-out views {', '.join(values)}"


def _first_points(trainer: Trainer) -> list[str]:
    own = len(trainer.scene.points)
    more = trainer.first_points - own
    return [f"started from the scene's {own} points and {more} more along the photos' edges"] if more else []


def _rates(trainer: Trainer) -> list[str]:
    left = trainer.method.rate_left
    why = "pixels held back from the noisy photos showed no gain any more"
    return [f"the learning rates fell to 1/{1 / left:.0f}: {why}"] if left < 1 else []


def _write_results(trainer: Trainer, out: Path) -> RunResult:
    scene, config = trainer.scene, trainer.config
    left_out = [*trainer.photos_left_out, *trainer.frugality.left_out()]

    def leave_out(what: str, why: str) -> None:
        left_out.append(LeftOut(what, why))

    for what, why in trainer.method.left_out():
        leave_out(what, why)
    rows = write_ply(out / PLY, trainer.method.modulate(trainer.gaussians))
    if rows:
        leave_out(f"{rows} Gaussians in {PLY}", "they hold NaN or Inf")
    guard = trainer.guard
    if guard.skipped:
        leave_out(f"{guard.skipped} training steps", "the loss or a gradient was not finite")
    if guard.culled:
        leave_out(f"{guard.culled} Gaussians", "a value or a gradient of theirs was not finite")
    if trainer.iteration < trainer.length:
        leave_out(f"iterations {trainer.iteration + 1} to {trainer.length}", "the run was stopped")
    if not scene.test:
        leave_out("held-out metrics", "the scene has no held-out view")
    views = trainer.render_test_views()
    culled = [view.culled for view in views if view.culled is not None]
    result = RunResult(
        scene=scene.name,
        source=scene.source,
        notes=[*scene.notes, *_first_points(trainer), *_rates(trainer)],
        method=config.method,
        seed=config.seed,
        iterations=trainer.iteration,
        seconds=trainer.seconds,
        gaussians=len(trainer.gaussians),
        peak_rss_mb=peak_rss_mb(),
        history=trainer.history,
        length=trainer.length,
        left_out=[item.known() for item in left_out],
        decision_seconds=trainer.frugality.state.decisions,
        scene_bytes=(out / PLY).stat().st_size,
        config=asdict(config),
        sfm=None if scene.sfm is None else asdict(scene.sfm),
        guard=guard.summary(),
        culled_in_a_view=sum(culled) / len(culled) if culled else None,
        views=views,
    )
    write_report(out, result)
    return result
