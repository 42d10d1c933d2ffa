"""Fit Gaussians to a picture with `hqgs.rasterization` in a torch loop of your own.

    python examples/fit_picture.py                   # a pattern that is made here, a minute on 2 cores
    python examples/fit_picture.py PHOTO.jpg

Code written for `gsplat.rasterization` looks the same.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import hqgs


def main() -> None:
    parser = argparse.ArgumentParser(description="Fit Gaussians to one picture.")
    parser.add_argument("picture", nargs="?", type=Path, help="(a pattern)")
    parser.add_argument("--size", type=int, default=128, help="width and height in pixels (%(default)s)")
    parser.add_argument("--gaussians", type=int, default=1_500, help="(%(default)s)")
    parser.add_argument("--iterations", type=int, default=300, help="(%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("outputs", "fit_picture.png"), help="(%(default)s)")
    args = parser.parse_args()

    torch.manual_seed(0)
    size, n = args.size, args.gaussians
    target = picture(args.picture, size)
    # All in a plane at depth 1 that the camera sees from edge to edge: 1 world unit is the picture's side.
    means = torch.cat([torch.rand(n, 2) - 0.5, torch.ones(n, 1)], dim=1)
    trained = {
        "means": means,
        "quats": torch.randn(n, 4),  # w x y z, any norm
        "scales": torch.full((n, 3), 0.5 / n**0.5).log(),  # logs of standard deviations
        "opacities": torch.zeros(n),  # logits
        "colors": torch.zeros(n, 3),  # logits
    }
    optimizer = torch.optim.Adam([tensor.requires_grad_() for tensor in trained.values()], lr=2e-2)
    viewmats = torch.eye(4)[None]  # [1, 4, 4], world to camera
    Ks = torch.tensor([[[float(size), 0, size / 2], [0, float(size), size / 2], [0, 0, 1]]])  # pixels
    image = torch.zeros_like(target)
    for iteration in range(args.iterations):
        [image], _, meta = hqgs.rasterization(
            trained["means"],
            trained["quats"],
            trained["scales"].exp(),
            trained["opacities"].sigmoid(),
            trained["colors"].sigmoid(),
            viewmats,
            Ks,
            size,
            size,
        )
        loss = (image - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if (iteration + 1) % max(1, args.iterations // 10) == 0:
            seen = len(meta["radii"])
            print(f"iteration {iteration + 1}: {-10 * loss.log10().item():.2f} dB, {seen} Gaussians in view")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    both = torch.cat([target, image.detach().clamp(0, 1)], dim=1)
    Image.fromarray((255 * both).round().byte().numpy()).save(args.out)
    print(f"the picture and the fit: {args.out}")


def picture(path: Path | None, size: int) -> torch.Tensor:
    """The picture [size, size, 3] in [0, 1]; without a path rings on a ramp of colours."""
    if path is not None:
        photo = Image.open(path).convert("RGB").resize((size, size), Image.Resampling.BOX)
        return torch.from_numpy(np.asarray(photo, np.float32) / 255)
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    rings = (torch.hypot(x, y) * 12).cos() > 0
    return torch.stack([(x + 1) / 2, rings.float(), (1 - y) / 2], dim=2)


if __name__ == "__main__":
    main()
