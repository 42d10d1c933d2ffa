"""Forward and backward of the rasterizer, stage by stage, against the limit of its arithmetic.

The limit is a lane of an AVX-512 core that does nothing but blend, with all lanes in use and all data in
cache (measured with a probe of the arithmetic).
"""

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
BLOCK_PIXELS = 16  # lanes of a block of 4 x 4 pixels
LIMIT_NS = 0.65 + 1.05  # of one core, for a pair that blends: forward, backward


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
        self.work = (0, 0, 0)  # of the last pass: pairs, blocks, blocks with a change
        self.blended = 0  # (Gaussian, pixel) pairs of the last pass that was timed

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
        composites = [composite for composite, *_ in clock.kept]  # which the crate counts and times itself
        self.blended = sum(composite.blended for composite in composites)
        return seconds | {BIN: sum(composite.bin_seconds for composite in composites)}

    def clear(self) -> None:
        """Free the gradients, so that the many cases of a benchmark fit into memory together."""
        for leaf in self.leaves:
            leaf.grad = None


def count_work(case: RasterPass, pixels: int) -> dict[str, Any]:
    """What the crate counted in the last pass: (Gaussian, pixel) pairs that changed one of so many pixels,
    (Gaussian, tile) pairs, (Gaussian, block) pairs that each pass evaluates, those that changed a pixel."""
    tile_pairs, blocks, changed_blocks = case.work
    return {
        "blended_per_pixel": case.blended / pixels,
        "tile_pairs": tile_pairs,
        "blocks": blocks,
        "changed_share": changed_blocks / blocks,
        "lane_use": case.blended / (BLOCK_PIXELS * blocks),
        "limit_core_seconds": case.blended * LIMIT_NS * 1e-9,
    }


def measure(inputs: Sequence[RasterInputs], repeats: int) -> list[dict[str, Any]]:
    """Time and work of each of the inputs; the limit is that of all threads."""
    passes = [RasterPass(x) for x in inputs]
    measured = interleaved({k: warmed(case) for k, case in enumerate(passes)}, repeats)
    rows = []
    for x, case, rounds in zip(inputs, passes, measured.values(), strict=True):
        work = count_work(case, x.width * x.height)
        limit = work.pop("limit_core_seconds") / hqgs.get_num_threads()
        stages = rounds[[*STAGES, "rest"]].median().to_dict()
        compositing = (rounds["bin and composite"] - rounds[BIN] + rounds["composite backward"]).median()
        row = {"case": f"{len(x):,}", "gaussians": len(x), "width": x.width, "height": x.height}
        row |= whole(rounds) | {"limit_seconds": limit, "compositing_seconds": compositing}
        rows.append(row | work | {"stages": stages})
    return rows
