"""The command line: `hqgs train SCENE --out DIR` and `hqgs degrade SCENE --kind KIND --out DIR`.

Exit codes: 0 done; 1 the run failed (a full disk, no Gaussians left); 2 bad input; 130 stopped by Ctrl-C or
SIGTERM. Then a training run has written everything, unless Ctrl-C was pressed twice, and degrading nothing.
"""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path

import hqgs
from hqgs.base.files import CHECKPOINT, write_json
from hqgs.base.left_out import LeftOut, format_left_out
from hqgs.cli.errors import BAD_INPUT, fail
from hqgs.cli.export import add_parser as add_export_parser
from hqgs.cli.export import run_export
from hqgs.diagnosis import diagnose_scene, format_diagnosis
from hqgs.evaluation.report import RunResult
from hqgs.photos.formula import parse_degradation
from hqgs.pipeline import open_run, run
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.degrade import check_new_folder, degrade_scene, write_degraded_scene
from hqgs.scene.load import load_scene
from hqgs.scene.restore import restore_scene
from hqgs.scene.scene import Scene
from hqgs.scene.sfm.reconstruct import KEPT, sfm_scene
from hqgs.training.config import (
    AUTO,
    GUIDANCES,
    ITEMS,
    METHODS,
    NONE,
    DensifyConfig,
    HQGSConfig,
    TrainConfig,
    parse_leave_out,
)
from hqgs.training.config import AUTO as LEAVE_OUT
from hqgs.training.trainer import TrainingError

EMBEDDED = "embedded"
EMBEDDED_SIZE = (504, 378)  # pixels
KINDS_HELP = (
    "jpeg:QUALITY, noise:SIGMA, lowres:FACTOR, blur[:SIGMA], defocus[:RADIUS], motion[:LENGTH], "
    "several joined by + in their order, mixed, or none"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code. SIGTERM counts as Ctrl-C."""
    args = _parser().parse_args(argv)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # instead of pycolmap's, with a stack trace
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
        default=LEAVE_OUT,
        metavar="LIST",
        help=f"what the run may do without where the scene does not need it: {LEAVE_OUT}, {NONE}, or some of "
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
    add("--resume", action="store_true", help="go on from the checkpoint in DIR, if there is one")

    degrade = commands.add_parser("degrade", help="write a scene with degraded training photos")
    degrade.set_defaults(run=_degrade)
    _add_scene(degrade, "folder for the new scene; missing or empty", config.seed)
    degrade.add_argument("--kind", required=True, help=KINDS_HELP)

    diagnose = commands.add_parser("diagnose", help="say what degraded a scene's training photos")
    diagnose.set_defaults(run=_diagnose)
    _add_photos(diagnose)
    diagnose.add_argument("--out", type=Path, metavar="FILE", help="also write the diagnosis as JSON")

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
    with ExitStack() as stack:
        try:
            config = _config(args)
            degradation = parse_degradation(args.degrade)
            if (args.out / CHECKPOINT).exists() and not args.resume:
                raise FileExistsError(
                    f"{args.out} holds a run; continue it with --resume or choose another --out"
                )
            if args.threads is not None:
                hqgs.set_num_threads(args.threads)
            scene = _scene(args, args.out, args.sfm, skip_unreadable="photos" in config.leave_out)
            if degradation.steps:
                scene = degrade_scene(scene, degradation, config.seed)
            if args.sfm and (scene.source != "photos" or degradation.steps):
                scene = sfm_scene(scene, args.out / KEPT)
                print(scene.sfm)
            if args.restore is not None:
                scene = restore_scene(scene, args.restore)
            trainer = stack.enter_context(open_run(scene, config, args.out, args.resume))
        except BAD_INPUT as error:
            return fail(2, str(error))
        except OSError as error:
            return fail(1, f"{args.out}: {error}")
        try:
            result = run(trainer, args.out)
        except TrainingError as error:
            return fail(1, str(error))
        except OSError as error:
            return fail(1, f"{args.out}: {error}")
    _print_summary(args.out, result)
    return 0 if result.iterations == result.length else 130


def _degrade(args: argparse.Namespace) -> int:
    try:
        degradation = parse_degradation(args.kind)
        check_new_folder(args.out)
        scene = _scene(args, out=None)
        write_degraded_scene(scene, args.out, degradation, args.seed)
    except BAD_INPUT as error:
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    print(f"{args.out}: {len(scene.train)} training photos with {degradation}, {len(scene.test)} held out")
    return 0


def _diagnose(args: argparse.Namespace) -> int:
    try:
        diagnosis = diagnose_scene(_scene(args, out=None))
        if args.out is not None:
            write_json(args.out, asdict(diagnosis))
    except BAD_INPUT as error:
        return fail(2, str(error))
    except OSError as error:
        return fail(1, f"{args.out}: {error}")
    print(format_diagnosis(diagnosis))
    return 0


def _export(args: argparse.Namespace) -> int:
    return run_export(args, lambda: None if args.scene is None else _scene(args, out=None))


def _config(args: argparse.Namespace) -> TrainConfig:
    leave_out = parse_leave_out(args.leave_out)
    if args.iterations is None and args.leave_out == LEAVE_OUT:
        leave_out = (*leave_out, "iterations")
    config = TrainConfig(
        iterations=TrainConfig.iterations if args.iterations is None else args.iterations,
        leave_out=leave_out,
        method=args.method,
        seed=args.seed,
        densify=DensifyConfig(max_gaussians=args.max_gaussians),
        hqgs=HQGSConfig(guidance=args.guidance, formation=args.formation),
    ).scaled()
    return config if args.eval_every is None else replace(config, eval_every=args.eval_every)


def _scene(
    args: argparse.Namespace, out: Path | None, sfm: bool = False, skip_unreadable: bool = False
) -> Scene:
    """`out`: the folder of the run, which keeps what is made of a scene; None keeps nothing."""
    if args.scene != EMBEDDED:
        keep = None if out is None else out / KEPT
        return load_scene(
            args.scene, args.downscale, reconstruct=sfm, skip_unreadable=skip_unreadable, keep_sfm=keep
        )
    if not args.downscale >= 1:
        raise ValueError(f"downscale must be at least 1, got {args.downscale}")
    width, height = (round(size / args.downscale) for size in EMBEDDED_SIZE)
    cache = None if out is None else out / "scene"
    return embedded_scene(cache=cache, width=width, height=height)


def _print_summary(out: Path, result: RunResult) -> None:
    last = result.history[-1]
    numbers = [f"{result.iterations} iterations", f"{result.gaussians} Gaussians", f"{result.seconds:.0f} s"]
    numbers += [] if last["psnr"] is None else [f"PSNR {last['psnr']:.2f} dB"]
    numbers += [] if last["ssim"] is None else [f"SSIM {last['ssim']:.4f}"]
    print(f"{out}: {', '.join(numbers)}")
    if table := format_left_out([LeftOut(**item) for item in result.left_out]):
        print(table)
