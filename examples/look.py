"""Pictures and a film of a trained scene: a camera of your own, a path through its cameras, an orbit.

python examples/look.py RUN                  # the folder of a run, for example outputs/bad_photos
python examples/look.py RUN --frames 240     # a film of 8 seconds

In a notebook, a cell that ends with `model`, `run` (of `hqgs.train`) or `hqgs.picture(image)` shows it.
"""

import argparse
from pathlib import Path

import torch

import hqgs


def main() -> None:
    parser = argparse.ArgumentParser(description="Render pictures, a film and a GIF of a run.")
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("--frames", type=int, default=90, help="of the film (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("outputs", "look"), help="(%(default)s)")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    model = hqgs.Gaussians.load(args.run)
    cameras = hqgs.load_cameras(args.run)

    path = hqgs.camera_path(cameras.train, args.frames)
    hqgs.render_frames(model, path, args.out / "path.mp4")  # needs the extra `video`; .gif does not
    hqgs.render_frames(model, hqgs.orbit(cameras.train, 24), args.out / "orbit.gif", fps=12)

    first = path[0]
    ahead = first.center + first.viewmat[2, :3]  # one unit along its line of sight
    wide = hqgs.look_at(first.center, ahead, up=cameras.up, width=480, height=270, fov=70)
    with torch.no_grad():
        image = model.render(wide)  # [H, W, 3], a tensor
    hqgs.picture(image).save(args.out / "wide.png")
    print(f"{len(model)} Gaussians, {len(path)} frames: {args.out}")


if __name__ == "__main__":
    main()
