"""Train a scene with plain 3DGS and look at the result.

    python examples/train_llff.py                 # the scene that is built in, under 5 minutes on 2 cores
    python examples/train_llff.py FOLDER          # a COLMAP, LLFF or nerfstudio folder

The output folder then holds report.json, comparison/*.png (photo | render | difference), error_vs_time.png
and scene.ply for any 3DGS viewer.
"""

import argparse
from pathlib import Path

from hqgs.base.left_out import LeftOut, format_left_out
from hqgs.evaluation.report import read_report
from hqgs.pipeline import train
from hqgs.scene.builtin import embedded_scene
from hqgs.scene.load import load_scene
from hqgs.training.config import NONE, TrainConfig, parse_leave_out


def main() -> None:
    parser = argparse.ArgumentParser(description="Train a scene with 3D Gaussian Splatting on the CPU.")
    parser.add_argument("scene", nargs="?", type=Path, help="scene folder; without it the built-in scene")
    parser.add_argument("--iterations", type=int, default=2_000)
    parser.add_argument("--out", type=Path, help="default: outputs/ and the scene's name")
    parser.add_argument("--downscale", type=float, default=1.0, help="divide the photos' sides by this")
    parser.add_argument("--method", default="3dgs")
    parser.add_argument("--leave-out", default=NONE, help="auto, none, or a list (%(default)s)")
    args = parser.parse_args()

    out = args.out or Path("outputs", "embedded" if args.scene is None else args.scene.resolve().name)
    if args.scene is None:
        width, height = round(504 / args.downscale), round(378 / args.downscale)
        scene = embedded_scene(cache=out / "scene", width=width, height=height)
    else:
        scene = load_scene(args.scene, downscale=args.downscale)
    leave_out = parse_leave_out(args.leave_out)
    config = TrainConfig(iterations=args.iterations, method=args.method, leave_out=leave_out).scaled()
    result = train(scene, config, out)

    print(f"{result.gaussians} Gaussians after {result.iterations} iterations in {result.seconds:.0f} s")
    for name, value in read_report(out / "report.json")["metrics"]["mean"].items():
        print(f"{name:>10}  {'-' if value is None else format(value, '.4f')}")
    if table := format_left_out([LeftOut(**item) for item in result.left_out]):
        print(table)
    print(f"pictures: {out / 'comparison'}")


if __name__ == "__main__":
    main()
