"""The command line: arguments in, text and exit codes out; the work is that of `hqgs.load`, `hqgs.train`, ...

Exit codes: 0 done; 1 the run failed (a full disk, no Gaussians left); 2 bad input; 130 stopped by Ctrl-C or
SIGTERM. Then a training run has written everything, unless Ctrl-C was pressed twice, and degrading nothing.
"""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import hqgs
from hqgs.base.files import CHECKPOINT, EMBEDDED, check_new_folder, existing_folder, write_json
from hqgs.base.left_out import format_left_out
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.export import add_parser as add_export_parser
from hqgs.cli.export import run_export
from hqgs.cli.progress import ProgressBar
from hqgs.cli.render import add_parser as add_render_parser
from hqgs.cli.view import LiveView
from hqgs.cli.view import add_options as add_view_options
from hqgs.cli.view import add_parser as add_view_parser
from hqgs.photos.formula import parse_degradation
from hqgs.training.config import AUTO, GUIDANCES, ITEMS, METHODS, NONE, TrainConfig, run_config

if TYPE_CHECKING:
    from hqgs.pipeline import Run
    from hqgs.scene.scene import Scene
    from hqgs.training.progress import Progress

KINDS_HELP = (
    "jpeg:QUALITY, noise:SIGMA, lowres:FACTOR, blur[:SIGMA], defocus[:RADIUS], motion[:LENGTH], shake[:PX], "
    "exposure[:EV], phone[:EV], chat[:SIDE], video[:CRF], some:KIND (half of the photos only), several "
    "joined by + in their order, mixed, or none"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code. SIGTERM counts as Ctrl-C."""
    args = _parser().parse_args(argv)
    try:
        return args.run(args)
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hqgs", description="3D Gaussian Splatting on the CPU for degraded photos."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    config = TrainConfig()

    train = commands.add_parser("train", help="train a scene and write a report")
    train.set_defaults(run=_train)
    _add_scene(train, "folder for the checkpoint and the report", config.seed)
    add = train.add_argument
    add("--method", default=AUTO, help=f"one of: {', '.join(METHODS)} (%(default)s)")
    add(
        "--iterations",
        type=int,
        metavar="N",
        help=f"training steps (at most {config.iterations}, fewer where the scene has stopped improving)",
    )
    add(
        "--leave-out",
        default=AUTO,
        metavar="LIST",
        help=f"what the run may do without where the scene does not need it: {AUTO}, {NONE}, or some of "
        f"{','.join(ITEMS)} (%(default)s)",
    )
    add(
        "--degrade", default="none", metavar="KIND", help=f"what happens to the training photos: {KINDS_HELP}"
    )
    add(
        "--sfm",
        action="store_true",
        help="poses and points from the training photos, by COLMAP; SCENE may hold photos alone",
    )
    add("--restore", type=Path, metavar="WEIGHTS", help="send the training photos through this network first")
    add("--guidance", default=config.hqgs.guidance, choices=GUIDANCES, help="of hqgs (%(default)s)")
    add(
        "--formation",
        default=config.hqgs.formation,
        metavar="KIND",
        help=f"what hqgs takes for the photos' degradation; {AUTO}: it looks (%(default)s)",
    )
    add("--threads", type=int, metavar="T", help="(all cores; the result does not depend on it)")
    add(
        "--max-gaussians",
        type=int,
        default=config.densify.max_gaussians,
        metavar="N",
        help="bounds the memory (%(default)s)",
    )
    add("--eval-every", type=int, metavar="N", help="iterations between evaluations (a tenth of the run)")
    add("--view", action="store_true", help="show the scene in a browser while it trains")
    add_view_options(train)
    add("--resume", action="store_true", help="go on from the checkpoint in DIR, if there is one")

    degrade = commands.add_parser("degrade", help="write a scene with degraded training photos")
    degrade.set_defaults(run=_degrade)
    _add_scene(degrade, "folder for the new scene; missing or empty", config.seed)
    degrade.add_argument("--kind", required=True, help=KINDS_HELP)

    diagnose = commands.add_parser("diagnose", help="say what degraded a scene's training photos")
    diagnose.set_defaults(run=_diagnose)
    _add_photos(diagnose)
    diagnose.add_argument("--out", type=Path, metavar="FILE", help="also write the diagnosis as JSON")

    add_render_parser(commands)
    add_view_parser(commands)
    add_export_parser(commands, _export)
    return parser


def _add_scene(parser: argparse.ArgumentParser, out: str, seed: int) -> None:
    """What every command takes that writes a folder."""
    _add_photos(parser)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help=out)
    add("--seed", type=int, default=seed, metavar="S", help="of everything random (%(default)s)")


def _add_photos(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scene", metavar="SCENE", help=f"scene folder, or {EMBEDDED!r} for the scene that is built in")
    add(
        "--downscale",
        type=float,
        default=1.0,
        metavar="F",
        help="divide the photos' sides by F (%(default)s)",
    )


def _train(args: argparse.Namespace) -> int:
    try:
        config = run_config(
            iterations=args.iterations,
            method=args.method,
            leave_out=args.leave_out,
            seed=args.seed,
            max_gaussians=args.max_gaussians,
            guidance=args.guidance,
            formation=args.formation,
            eval_every=args.eval_every,
        )
        parse_degradation(args.degrade)
        if (args.out / CHECKPOINT).exists() and not args.resume:
            raise FileExistsError(
                f"{args.out} holds a run; continue it with --resume or choose another --out"
            )
        if args.threads is not None:
            hqgs.set_num_threads(args.threads)
        _ready(args.scene)
        scene = hqgs.load(
            args.scene,
            downscale=args.downscale,
            sfm=args.sfm,
            degrade=args.degrade,
            seed=args.seed,
            restore=args.restore,
            skip_unreadable="photos" in config.leave_out,
            cache=args.out,
        )
        if scene.sfm is not None:
            print(scene.sfm)
        live = LiveView(scene, args.out, port=args.port, open_browser=args.open) if args.view else None
        with ProgressBar() as bar:

            def show(now: Progress) -> None:
                bar(now)
                if live is not None:
                    live(now)

            done = hqgs.train(scene, out=args.out, config=config, resume=args.resume, progress=show)
    except BAD_INPUT as error:
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    except hqgs.TrainingError as error:
        return fail(1, str(error))
    _print_summary(args.out, done)
    if live is not None and done.finished:
        live.stay()
    return 0 if done.finished else 130


def _degrade(args: argparse.Namespace) -> int:
    try:
        degradation = parse_degradation(args.kind)
        check_new_folder(args.out)
        scene = _load(args)
        from hqgs.scene.degrade import write_degraded_scene  # here: it loads torch

        write_degraded_scene(scene, args.out, degradation, args.seed)
    except BAD_INPUT as error:
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    print(f"{args.out}: {len(scene.train)} training photos with {degradation}, {len(scene.test)} held out")
    return 0


def _diagnose(args: argparse.Namespace) -> int:
    try:
        scene = _load(args)
        diagnosis = hqgs.diagnose(scene)
        if args.out is not None:
            write_json(args.out, asdict(diagnosis))
    except BAD_INPUT as error:
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    print(diagnosis)
    return 0


def _export(args: argparse.Namespace) -> int:
    return run_export(args, lambda: None if args.scene is None else _load(args))


def _load(args: argparse.Namespace) -> Scene:
    _ready(args.scene)
    return hqgs.load(args.scene, downscale=args.downscale, skip_unreadable=False)


def _ready(scene: str) -> None:
    """Tell a wrong path at once; then load what takes seconds, after which SIGTERM counts as Ctrl-C."""
    if scene != EMBEDDED:
        existing_folder(scene)
    import_module("hqgs.pipeline")
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # instead of pycolmap's, with a stack trace


def _print_summary(out: Path, done: Run) -> None:
    last = done.history[-1]
    numbers = [f"{done.iterations} iterations", f"{len(done.model)} Gaussians", f"{done.seconds:.0f} s"]
    numbers += [] if last["psnr"] is None else [f"PSNR {last['psnr']:.2f} dB"]
    numbers += [] if last["ssim"] is None else [f"SSIM {last['ssim']:.4f}"]
    print(f"{out}: {', '.join(numbers)}")
    if table := format_left_out(done.left_out):
        print(table)
