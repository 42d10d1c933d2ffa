"""`hqgs train SCENE --out DIR`."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

import hqgs
from hqgs.base.files import CHECKPOINT, CONFIG, PAGE, PLY
from hqgs.base.left_out import format_left_out
from hqgs.base.ranks import RankError, Ranks, joined
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.out_folder import check_out
from hqgs.cli.parse import parse
from hqgs.cli.progress import LoadingScreen, Times, TrainingScreen, duration
from hqgs.cli.ranks import restarted, told_by_the_first
from hqgs.cli.scenes import Apart, Factor, Flag, Folder, Kind, Number, Photos, ready, tell_notes
from hqgs.cli.view import LiveView, Open, Port
from hqgs.evaluation.verdict import judged_by, overdone, told, verdict
from hqgs.photos.formula import parse_degradation
from hqgs.scene.names import KEPT
from hqgs.show.constants import PORT
from hqgs.show.viewer.guard import check
from hqgs.training.config import AUTO, ITEMS, METHODS, NONE, TrainConfig, run_config
from hqgs.training.settings import (
    PRESETS,
    config_of_values,
    config_values,
    longest_side,
    read_config,
    with_iterations,
    with_plan,
)

if TYPE_CHECKING:
    from hqgs.pipeline import Run
    from hqgs.training.progress import Progress

EXPERT = "--config."
# Options that shape the scene.
LOADING = ("downscale", "test_every", "sfm", "degrade", "restore", "frames", "distance", "tag_size", "up")
VIEWERS = "SuperSplat (superspl.at/editor) and other viewers of 3DGS files"


@dataclass(frozen=True, kw_only=True)
class Train(Photos):
    """Options of `hqgs train`. None: as the preset, the file of --config or the resumed run says."""

    out: Folder
    """Folder for the scene, the report and what is needed to go on."""
    preset: Literal["quick", "standard", "best"] = "standard"
    """quick: 1,000 iterations on small photos, a first look. standard: as long as it pays,
    photos of at most 1600 px. best: 30,000 iterations, photos as they are."""
    iterations: Number = None
    """Training views to see (standard: 150 for each clean photo, 4,000 at least, at most 30,000, fewer where
    the scene has stopped improving)."""
    batch: Number = None
    """Views in a step (1). Several processes of torchrun share them out: docs/machines.md."""
    seconds: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """Train for S seconds, in place of --iterations: the best scene that this machine makes in them."""
    plan: Annotated[Path | None, tyro.conf.arg(metavar="RUN", help_behavior_hint="")] = None
    """Repeat what the seconds of another run came to, bit for bit: its folder, or its plan.json."""
    method: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", help_behavior_hint="", help=f"One of {', '.join(METHODS)} (auto)."),
    ] = None
    downscale: Factor = None
    """Divide the photos' sides by F (as the preset says)."""
    test_every: Annotated[int, tyro.conf.arg(metavar="N")] = 8
    """Hold out every Nth photo to measure with; 0: train on all photos."""
    resume: Flag = False
    """Go on with the run in DIR; with a larger --iterations also where it has come to its end."""
    overwrite: Flag = False
    """Begin anew in a folder that holds a run."""
    sfm: Flag = False
    """Cameras and points from the training photos, by COLMAP, where the scene has some already."""
    frames: Number = None
    """Frames to take from a film (two a second, 30 to 90)."""
    distance: Apart = None
    """Metres between the cameras of the photos A and B, or points x,y,z: the scene is written in metres."""
    tag_size: Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="")] = None
    """Width of printed tags (AprilTag 36h11, ArUco) in the scene: it is written in metres, upright."""
    up: Annotated[
        tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z", help_behavior_hint="")
    ] = None
    """Where up is, in the frame of the photos' cameras (as upright edges, tags, GPS or EXIF tell it)."""
    degrade: Kind = "none"
    restore: Annotated[Path | None, tyro.conf.arg(metavar="WEIGHTS", help_behavior_hint="")] = None
    """Send the training photos through this restoration network first."""
    formation: Annotated[str | None, tyro.conf.arg(metavar="KIND", help_behavior_hint="")] = None
    """What hqgs takes for the photos' degradation (auto: it looks)."""
    guidance: Annotated[
        Literal["formation", "paper"] | None,
        tyro.conf.arg(help="Of hqgs: formation, or paper, its published form.", help_behavior_hint=""),
    ] = None
    leave_out: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="LIST",
            help_behavior_hint="",
            help=f"What the run may do without where the scene does not need it: {AUTO}, {NONE}, or some of "
            f"{','.join(ITEMS)} ({AUTO}); a list without iterations trains all of them.",
        ),
    ] = None
    max_gaussians: Number = None
    """Bounds the memory (1,000,000)."""
    eval_every: Number = None
    """Iterations between evaluations (a tenth of the run, 50 at least)."""
    view: Flag = False
    """Show the scene in a browser while it trains, and afterwards until Ctrl-C."""
    port: Port = PORT
    open: Open = False
    threads: Number = None
    """CPU threads (all cores; the result does not depend on it)."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """Another seed gives another run of the same quality (0)."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Train with the configuration in this file: config.json of another run."""
    help_all: Flag = False
    """Show every number of the training too: --config.densify.grad-threshold and so on."""


@dataclass(frozen=True, kw_only=True)
class Whole(Train):
    """With every number of the configuration."""

    expert: Annotated[TrainConfig, tyro.conf.arg(name="config")] = field(default_factory=TrainConfig)


OPTIONS = Train


def read(options: type[Train], command: str, about: str, arguments: Sequence[str]) -> Train:
    """As `parse`; options of the configuration change what the other options come to."""
    if "--help-all" in arguments:
        return parse(Whole, command, about, ["--help"])
    if not any(argument.startswith(EXPERT) for argument in arguments):
        return parse(options, command, about, arguments)
    first = parse(Whole, command, about, arguments)
    try:
        base = Whole(scene=first.scene, out=first.out, expert=config_of(first))
    except BAD_INPUT as error:
        raise SystemExit(fail(2, error)) from None
    return parse(Whole, command, about, arguments, base)


def config_of(options: Train) -> TrainConfig:
    """The configuration that the options ask for. ValueError for a bad one."""
    preset = PRESETS[options.preset]
    kept = options.out / CONFIG
    file = options.config
    if file is None and options.resume and kept.is_file() and (options.out / CHECKPOINT).exists():
        file = kept
    iterations = options.iterations
    given = [name for name in ("iterations", "seconds", "plan") if getattr(options, name) is not None]
    if len(given) > 1:
        raise ValueError(f"only one of --{' and --'.join(given)} can be given")
    if file is not None:
        config = read_config(file)
        # Else the checkpoint alone knows how long the run was.
        known = "iterations" not in config.leave_out and config.seconds is None
        if known and file == kept and iterations is not None and iterations < config.iterations:
            raise ValueError(
                f"iterations is {iterations}, and the run in {options.out} has {config.iterations}: --resume "
                "can make it longer, not shorter"
            )
        if iterations is not None and (iterations != config.iterations or not known):
            config = replace(with_iterations(config, iterations), seconds=None, turn=None, timed=None)
    else:
        length = preset.iterations if iterations is None else iterations
        config = run_config(iterations=length, leave_out=options.leave_out or AUTO)
    asked = run_config(iterations=config.iterations, leave_out=options.leave_out or AUTO)
    changes: dict[str, Any] = {
        name: value
        for name in ("method", "seed", "eval_every", "batch")
        if (value := getattr(options, name)) is not None
    }
    if options.leave_out is not None and file is not None:
        changes["leave_out"] = asked.leave_out
    if options.max_gaussians is not None:
        changes["densify"] = replace(config.densify, max_gaussians=options.max_gaussians)
    of_hqgs = {
        name: value for name in ("guidance", "formation") if (value := getattr(options, name)) is not None
    }
    if options.seconds is not None:
        changes["seconds"] = options.seconds
    config = replace(config, hqgs=replace(config.hqgs, **of_hqgs), **changes)
    return config if options.plan is None else with_plan(config, options.plan)


def scene_of_run(out: Path) -> dict[str, Any]:
    """What the run in a folder asked `hqgs.load` for; empty where nothing tells."""
    if not ((out / CONFIG).is_file() and (out / CHECKPOINT).is_file()):
        return {}
    try:
        origin = json.loads((out / CONFIG).read_text(encoding="utf-8")).get("scene") or {}
    except (ValueError, AttributeError):
        return {}
    return {name: value for name, value in origin.items() if name in (*LOADING, "longest")}


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
            return fail(130, "stopped at once; --resume goes on from the last checkpoint")
        found = " The same command goes on with what COLMAP has found" if (out / KEPT).exists() else ""
        return fail(130, f"stopped before the first checkpoint.{found}")
    except BAD_INPUT as error:
        return fail(2, error)
    except OSError as error:
        return fail(1, f"{out}: {error}")
    except (hqgs.TrainingError, RankError) as error:
        return fail(1, str(error))
    code = 0 if done.finished else 130
    if not ranks.first:
        return code
    times = Times(started, loaded, bar.began or loaded, bar.ended or loaded, time.perf_counter())
    _summary(options, done, screen.colmap_seconds, times)
    if not done.finished:
        command = shlex.join(["hqgs", "train", options.scene, "--out", str(out), "--resume"])
        print(
            f"stopped at iteration {done.iterations} of {done.length}; go on with: {command}", file=sys.stderr
        )
    if live is not None:
        live.stay() if done.finished else live.close()
    return code


def _train(options: Train, ranks: Ranks) -> tuple[Run, LiveView | None, LoadingScreen, TrainingScreen, float]:
    """The run, what has shown it, and when its scene was loaded."""
    config = _checked(options) if ranks.first else None
    config = config_of_values(ranks.tell(config and config_values(config))[0], "rank 0")
    if options.threads is not None:
        hqgs.set_num_threads(options.threads)
    elif ranks.local > 1:
        hqgs.set_num_threads(max(1, hqgs.get_num_threads() // ranks.local))
    ready(options.scene)
    from hqgs.scene.next_photos import told_next  # here: it loads scenes

    asked = ranks.tell(_asked(options, config) if ranks.first else None)[0]
    with LoadingScreen() as screen:
        if not ranks.first:
            ranks.tell(None)  # what COLMAP finds for the first one, the others read
        scene = hqgs.load(
            **asked, skip_unreadable="photos" in config.leave_out, cache=options.out, on_stage=screen.stage
        )
        if ranks.first:
            ranks.tell(None)
    tell_notes(scene)
    loaded = time.perf_counter()
    length = f"at most {config.iterations:,} iterations"
    if options.seconds is not None:
        length = f"{duration(options.seconds)} of training"
    print(f"looking at the photos, then {length}", flush=True)
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
            config=config,
            resume=options.resume,
            overwrite=options.overwrite,
            progress=show,
            on_stage=bar.stage,
            ranks=ranks,
        )
    for line in told_next(scene) if ranks.first else []:
        print(line)
    return done, live, screen, bar, loaded


def _checked(options: Train) -> TrainConfig:
    """The configuration of options that can be used."""
    config = options.expert if isinstance(options, Whole) else config_of(options)
    parse_degradation(options.degrade)
    for line in check_out(options.out, options.scene, options.resume, options.overwrite):
        print(line, flush=True)
    if options.view:
        check(options.port)
    return config


def _asked(options: Train, config: TrainConfig) -> dict[str, Any]:
    """What `hqgs.load` is to give; where a run goes on, as it was, but for what the options say otherwise."""
    asked: dict[str, Any] = {
        name: value for name in LOADING if (value := getattr(options, name)) != getattr(Train, name)
    }
    sized = options.downscale is not None or options.preset != Train.preset
    before = scene_of_run(options.out) if options.resume else {}
    if sized or not before:
        asked["longest"] = longest_side(options.preset, options.downscale)
        before.pop("downscale", None)
    if "restore" in asked:
        asked["restore"] = str(asked["restore"])
    return before | asked | {"path": options.scene, "seed": config.seed}


def _summary(options: Train, done: Run, colmap: float, times: Times) -> None:
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
    if fell := overdone(done.history):
        print(fell)
    print(f"time: {times.told(colmap)}")
    print(f"to send: {out / PAGE}, which any browser opens; {VIEWERS} open {out / PLY}")
    if not options.view:
        print(f"now look at it: {shlex.join(['hqgs', 'view', str(out)])}")
