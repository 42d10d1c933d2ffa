"""Photos go bad, hqgs says how, trains with what that calls for, and writes the scene.

python examples/bad_photos.py                          # the built-in scene with noise, minutes on 2 cores
python examples/bad_photos.py FOLDER --kind none       # photos of your own, as they are
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import hqgs


def main() -> None:
    parser = argparse.ArgumentParser(description="Degrade, diagnose, train, save, render.")
    parser.add_argument("scene", nargs="?", default="embedded", help="scene folder (the built-in scene)")
    parser.add_argument("--kind", default="noise:25", help="what happens to the photos (%(default)s)")
    parser.add_argument("--iterations", type=int, default=1_000, help="training views to see (%(default)s)")
    parser.add_argument("--downscale", type=float, default=2.0, help="divide the photos' sides by this")
    parser.add_argument("--out", type=Path, default=Path("outputs", "bad_photos"), help="(%(default)s)")
    args = parser.parse_args()

    scene = hqgs.load(args.scene, downscale=args.downscale, cache=args.out)
    scene = hqgs.degrade(scene, args.kind)
    print(hqgs.diagnose(scene))

    run = hqgs.train(scene, iterations=args.iterations, progress=show)  # with out=FOLDER the report is kept
    for item in run.left_out:
        print(f"left out: {item.what}: {item.why}")

    args.out.mkdir(parents=True, exist_ok=True)
    run.model.save(args.out / "scene.ply")
    run.model.save(args.out / "scene.spz")  # a tenth as large
    model = hqgs.Gaussians.load(args.out / "scene.ply")  # a file of 3DGS, gsplat or Brush would do as well
    with torch.no_grad():
        image = model.render(scene.test[0].camera)  # [H, W, 3], not clamped
    picture = (255 * image.clamp(0, 1)).round().byte().numpy()
    Image.fromarray(picture).save(args.out / "render.png")
    print(f"{len(model)} Gaussians and a view: {args.out}")


def show(now: hqgs.Progress) -> None:
    """One line for each evaluation on the held-out views."""
    if now.evaluated is not None and now.evaluated["psnr"] is not None:
        print(f"iteration {now.iteration} of {now.length}: {now.evaluated['psnr']:.2f} dB", flush=True)


if __name__ == "__main__":
    main()
