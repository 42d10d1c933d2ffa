"""Train a scene and look at the result.

    python examples/train_llff.py                 # the scene that is built in, under 2 minutes on 2 cores
    python examples/train_llff.py FOLDER          # a COLMAP, LLFF or nerfstudio folder

The output folder then holds report.html, report.json, comparison/*.png (photo | render | difference) and
scene.ply for any 3DGS viewer. A second call begins anew.
"""

import argparse
from pathlib import Path

import hqgs


def main() -> None:
    parser = argparse.ArgumentParser(description="Train a scene with 3D Gaussian Splatting on the CPU.")
    parser.add_argument("scene", nargs="?", default="embedded", help="scene folder (the built-in scene)")
    parser.add_argument("--iterations", type=int, default=1_500, help="training views to see (%(default)s)")
    parser.add_argument("--out", type=Path, help="(outputs/ and the scene's name)")
    parser.add_argument("--downscale", type=float, default=1.0, help="divide the photos' sides by this")
    parser.add_argument("--method", default="auto", help="auto, 3dgs, srgs or hqgs (%(default)s)")
    parser.add_argument("--leave-out", default="auto", help="auto, none, or a list (%(default)s)")
    args = parser.parse_args()

    out = args.out or Path("outputs", Path(args.scene).resolve().name)
    scene = hqgs.load(args.scene, downscale=args.downscale, cache=out)
    run = hqgs.train(
        scene,
        out=out,
        iterations=args.iterations,
        method=args.method,
        leave_out=args.leave_out,
        overwrite=True,
        progress=show,
    )

    print(f"{len(run.model)} Gaussians after {run.iterations} iterations in {run.seconds:.0f} s")
    for name, value in run.report["metrics"]["mean"].items():
        print(f"{name:>10}  {'-' if value is None else format(value, '.4f')}")
    for item in run.left_out:
        print(f"left out: {item.what}: {item.why}")
    print(f"pictures: {out / 'comparison'}")


def show(now: hqgs.Progress) -> None:
    """One line for each evaluation on the held-out views."""
    if now.evaluated is not None and now.evaluated["psnr"] is not None:
        print(f"iteration {now.iteration} of {now.length}: {now.evaluated['psnr']:.2f} dB", flush=True)


if __name__ == "__main__":
    main()
