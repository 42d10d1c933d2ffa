"""Forward and backward of the rasterizer, stage by stage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

import hqgs
from benchmarks.patches import COMPOSITE, CRATE
from benchmarks.speed.inputs import LEAVES, RasterInputs
from benchmarks.speed.timing import Seconds, StageClock, interleaved, warmed, whole

STAGES = list(CRATE.values())
BIN = "bin"  # what the tile lists take of "bin and composite"


class RasterPass:
    """`hqgs.rasterization` at its defaults with harmonics of degree 3, and its backward pass, timed; all
    gradients but the camera's. torch has the threads that it has. The same numbers in any `dtype`."""

    def __init__(self, inputs: RasterInputs, dtype: torch.dtype = torch.float32) -> None:
        tensors = (torch.from_numpy(getattr(inputs, name)) for name in LEAVES)
        self.leaves = [tensor.to(dtype).requires_grad_() for tensor in tensors]
        viewmat, K = (torch.from_numpy(m[None]).float() for m in (inputs.viewmat, inputs.K))
        self.arguments: dict[str, Any] = dict(zip((*LEAVES[:4], "colors"), self.leaves, strict=True))
        self.arguments |= {"viewmats": viewmat, "Ks": K, "width": inputs.width, "height": inputs.height}
        self.arguments |= {"backgrounds": torch.from_numpy(inputs.background[None]).to(dtype), "sh_degree": 3}
        self.v_image = torch.from_numpy(inputs.v_image[None]).to(dtype)
        self.work = (0, 0)  # of the last pass: pairs of Gaussian and tile, of Gaussian and block

    def run(self) -> torch.Tensor:
        """One pass; returns the image [1, H, W, 3], the gradients are in the leaves."""
        image, _, meta = hqgs.rasterization(**self.arguments)
        image.backward(self.v_image)
        self.work = meta["work"]
        return image.detach()

    def __call__(self) -> Seconds:
        clock = StageClock(keep=CRATE[COMPOSITE])
        with clock.watching(CRATE):
            seconds = clock.seconds(self.run, STAGES)
        self.clear()
        return seconds | {BIN: sum(composite.bin_seconds for composite, *_ in clock.kept)}

    def clear(self) -> None:
        """Free the gradients, so that the many cases of a benchmark fit into memory together."""
        for leaf in self.leaves:
            leaf.grad = None


def measure(inputs: Sequence[RasterInputs], repeats: int) -> list[dict[str, Any]]:
    """Time and work of each of the inputs."""
    passes = [RasterPass(x) for x in inputs]
    measured = interleaved({k: warmed(case) for k, case in enumerate(passes)}, repeats)
    rows = []
    for x, case, rounds in zip(inputs, passes, measured.values(), strict=True):
        stages = rounds[[*STAGES, "rest"]].median().to_dict()
        compositing = (rounds["bin and composite"] - rounds[BIN] + rounds["composite backward"]).median()
        row = {"case": f"{len(x):,}", "gaussians": len(x), "width": x.width, "height": x.height}
        row |= whole(rounds) | {"compositing_seconds": compositing, "stages": stages}
        rows.append(row | dict(zip(("tile_pairs", "blocks"), case.work, strict=True)))
    return rows
