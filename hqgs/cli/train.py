"""`hqgs train SCENE --out DIR`."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

import hqgs
from hqgs.base.files import CHECKPOINT, PAGE, PLY, lock_folder
from hqgs.base.left_out import format_left_out
from hqgs.base.options import Flag, Folder, Number, Unsaid
from hqgs.base.ranks import RankError, Ranks, joined, restarts
from hqgs.cli.errors import fail
from hqgs.cli.parse import parse
from hqgs.cli.progress import LoadingScreen, TrainingScreen, duration, told_times
from hqgs.cli.scenes import Photos, check_out, ready, tell_notes
from hqgs.cli.view import LiveView, Open, Port
from hqgs.evaluation.run_folder import RunFolder
from hqgs.evaluation.verdict import judged_by, overdone, told, verdict
from hqgs.photos.formula import parse_degradation
from hqgs.scene.names import KEPT, is_room
from hqgs.scene.options import LoadOptions, PhotoOptions
from hqgs.show.viewer.guard import PORT, check
from hqgs.training.config import (
    PresetOption,
    Said,
    TrainConfig,
    TrainingError,
    TrainOptions,
    decided,
    longest_side,
    merged,
    read_plan,
    read_said,
    resumed,
)

if TYPE_CHECKING:
    from hqgs.pipeline import Progress, Run

EXPERT = "--config."
VIEWERS = "SuperSplat (superspl.at/editor) and other 3DGS viewers"


@dataclass(frozen=True, kw_only=True)
class _Into(Photos):
    out: Folder
    """Folder for the scene, the report and the checkpoint."""


@dataclass(frozen=True, kw_only=True)
class Train(PhotoOptions, TrainOptions, PresetOption, _Into):
    """Options of `hqgs train`. Default: as the preset, the file of --config or the resumed run says."""

    resume: Flag = False
    """Continue the run in DIR; a finished run needs a larger --iterations."""
    overwrite: Flag = False
    """Start again in a folder that holds a run."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), Unsaid] = None
    """Train with the configuration of another run: its config.json."""
    plan: Annotated[Path | None, tyro.conf.arg(metavar="RUN"), Unsaid] = None
    """Repeat a run with --seconds bit for bit: its folder, or its plan.json."""
    view: Flag = False
    """Show the scene in a browser while it trains, and afterwards until Ctrl-C."""
    port: Port = PORT
    open: Open = False
    threads: Number = None
    """CPU threads (all cores); the result does not depend on them."""
    help_all: Flag = False
    """Also show the options for every number of the training, such as --config.densify.grad-threshold."""
    numbers: Annotated[Said, tyro.conf.Suppress] = field(default_factory=dict)
    """Those of them that were said."""


@dataclass(frozen=True, kw_only=True)
class Whole(Train):
    """All options, with every number of the configuration; `numbers` has those that were said."""

    every: Annotated[TrainConfig, tyro.conf.arg(name="config")] = field(default_factory=TrainConfig)


OPTIONS = Train


def read(options: type[Train], command: str, about: str, arguments: Sequence[str]) -> Train:
    """As `parse`, with those numbers of the configuration that the arguments name."""
    if "--help-all" in arguments:
        return parse(Whole, command, about, ["--help"])
    named = [argument.split("=")[0][len(EXPERT) :] for argument in arguments if argument.startswith(EXPERT)]
    if not named:
        return parse(options, command, about, arguments)
    whole, numbers = parse(Whole, command, about, arguments), dict[str, Any]()
    for name in named:
        *parts, last = name.replace("-", "_").split(".")
        inner, value = numbers, whole.every
        for part in parts:
            inner, value = inner.setdefault(part, {}), getattr(value, part)
        last = last if hasattr(value, last) else last.removeprefix("no_")
        inner[last] = getattr(value, last)
    return replace(whole, numbers=numbers)


def asked_for(options: Train) -> Said:
    """What the options say of the configuration, and a file or the run that goes on. ValueError."""
    if len(given := [n for n in ("iterations", "seconds", "plan") if getattr(options, n) is not None]) > 1:
        raise ValueError(f"give only one of --{' and --'.join(given)}")
    now = options.said() | ({} if options.preset is None else {"preset": options.preset})
    now = now if options.plan is None else merged(now, read_plan(options.plan))
    now = merged(now, options.numbers)
    if options.config is not None:
        return merged(read_said(options.config), now)
    return resumed(options.out, now) if options.resume else now


def run(options: Train) -> int:
    """Train what the options say; return the exit code."""
    started, out = time.perf_counter(), options.out
    try:
        with joined() as ranks, told_by_the_first(ranks):
            if restarted(out, options.overwrite, ranks):
                options = replace(options, resume=True, overwrite=False)
            done, live, screen, bar, loaded = _train(options, ranks)
    except KeyboardInterrupt:
        if (out / CHECKPOINT).exists():
            return fail(130, "stopped at once; --resume continues from the last checkpoint")
        found = " The same command continues with what COLMAP has found" if (out / KEPT).exists() else ""
        return fail(130, f"stopped before the first checkpoint.{found}")
    except (TrainingError, RankError) as error:
        return fail(1, str(error))
    code = 0 if done.finished else 130
    if not ranks.first:
        return code
    _summary(options, done, told_times(started, loaded, bar, screen.colmap_seconds))
    if not done.finished:
        command = shlex.join(["hqgs", "train", options.scene, "--out", str(out), "--resume"])
        print(
            f"stopped at iteration {done.iterations} of {done.length}; continue with: {command}",
            file=sys.stderr,
        )
    if live is not None:
        live.stay() if done.finished else live.close()
    return code


@contextmanager
def told_by_the_first(ranks: Ranks) -> Iterator[None]:
    """Nothing is shown but by the first rank; how a rank ends, each one tells."""
    if ranks.first:
        yield
        return
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        redirect_stdout(nowhere),
        redirect_stderr(nowhere),
    ):
        yield


def restarted(out: Path, overwrite: bool, ranks: Ranks) -> bool:
    """Whether torchrun has started the run in `out` again after a fault, so that it goes on.

    With `overwrite` a first start removes the checkpoint there, or a restart would go on with the older run.
    """
    if restarts():
        return True
    if overwrite and ranks.count > 1 and ranks.first and out.is_dir():
        with lock_folder(out):
            (out / CHECKPOINT).unlink(missing_ok=True)
    return False


def _train(options: Train, ranks: Ranks) -> tuple[Run, LiveView | None, LoadingScreen, TrainingScreen, float]:
    """The run, what has shown it, and when its scene was loaded."""
    said = ranks.tell(_checked(options) if ranks.first else None)[0]
    config = decided(said)
    if options.threads is not None:
        hqgs.set_num_threads(options.threads)
    elif ranks.local > 1:
        hqgs.set_num_threads(max(1, hqgs.get_num_threads() // ranks.local))
    ready(options.scene)
    from hqgs.scene.source import load_as  # here: it loads torch

    asked = ranks.tell(loading(options, config) if ranks.first else None)[0]
    with LoadingScreen() as screen:
        if not ranks.first:
            ranks.tell(None)  # what COLMAP finds for the first one, the others read
        scene = load_as(LoadOptions(**asked), options.out, on_stage=screen.stage)
        if ranks.first:
            ranks.tell(None)
    tell_notes(scene)
    loaded = time.perf_counter()
    length = f"at most {config.iterations:,} iterations"
    if config.seconds is not None:
        length = f"{duration(config.seconds)} of training"
    print(f"measuring the photos, then {length}", flush=True)
    live = None
    if options.view and ranks.first:
        live = LiveView(scene, options.out, port=options.port, open_browser=options.open)
    with TrainingScreen() as bar:

        def show(now: Progress) -> None:
            bar(now)
            if live is not None:
                live(now)

        done = hqgs.train(
            scene,
            out=options.out,
            config=said,
            resume=options.resume,
            overwrite=options.overwrite,
            progress=show,
            on_stage=bar.stage,
            ranks=ranks,
        )
    return done, live, screen, bar, loaded


def _checked(options: Train) -> Said:
    """What options that can be used say of the configuration."""
    said = asked_for(options)
    decided(said)
    parse_degradation(options.degrade or "none")
    for line in check_out(options.out, options.scene, options.resume, options.overwrite):
        print(line, flush=True)
    if options.view:
        check(options.port)
    return said


def loading(options: Train, config: TrainConfig) -> dict[str, Any]:
    """What `load_as` is to give, as JSON values; where a run goes on, as it was, but for what is said."""
    run = RunFolder(options.out)
    before = dict(run.loaded) if options.resume and run.is_run else {}
    if options.downscale is not None or options.preset is not None or not before:
        before |= {"longest": longest_side(options.preset, options.downscale), "downscale": None}
    path = str(options.scene if is_room(options.scene) else Path(options.scene).expanduser().resolve())
    said = {option.name: getattr(options, option.name) for option in fields(PhotoOptions)}
    said = {name: value for name, value in said.items() if value is not None and value is not False}
    return (
        before | said | {"path": path, "seed": config.seed, "skip_unreadable": "photos" in config.leave_out}
    )


def _summary(options: Train, done: Run, times: str) -> None:
    out, last = options.out, done.history[-1]
    numbers = [f"{done.iterations} iterations", f"{len(done.model)} Gaussians", f"{done.seconds:.0f} s"]
    found, ssim = (told(done.report, *form) for form in (("psnr", ".2f"), ("ssim", ".4f")))
    numbers += ([f"PSNR {found} dB"] if found else []) + ([f"SSIM {ssim}"] if ssim else [])
    print(f"{out}: {', '.join(numbers)}")
    if table := format_left_out(done.left_out):
        print(table)
    psnr, name = judged_by(done.report)
    word, why = verdict(psnr, done.report["metrics"])
    print(f"quality: {word} ({why})" + ("" if psnr in (None, last["psnr"]) else f"; {psnr:.2f} dB {name}"))
    if fell := done.report.get("fallen") or overdone(done.history):
        print(fell)
    print(f"time: {times}")
    print(f"to share: {out / PAGE} opens in any browser; {VIEWERS} open {out / PLY}")
    if not options.view:
        print(f"next, to see it: {shlex.join(['hqgs', 'view', str(out)])}")
