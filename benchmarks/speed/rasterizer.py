"""Forward and backward of the rasterizer, stage by stage, against the limit of its arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch

import hqgs
from benchmarks.places import COMPOSITE, CRATE
from benchmarks.speed.inputs import LEAVES, RasterInputs
from benchmarks.speed.timing import Seconds, StageClock, interleaved, median_ratio, whole
from benchmarks.speed.work import count_work
from hqgs.base.threads import one_torch_thread

STAGES = list(CRATE.values())
BIN = "bin"  # the part of "bin and composite" before the first pixel


class RasterPass:
    """`hqgs.rasterization` with harmonics of degree 3 and its backward pass, timed; all gradients but the
    camera's. Works the same way on another `device` with another implementation of the function, and with
    the same numbers in another `dtype`."""

    def __init__(
        self,
        inputs: RasterInputs,
        rasterize: Callable[..., Any] = hqgs.rasterization,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        tensors = (torch.from_numpy(getattr(inputs, name)) for name in LEAVES)
        self.leaves = [tensor.to(device, dtype).requires_grad_() for tensor in tensors]
        viewmat, K = (torch.from_numpy(m[None]).float().to(device) for m in (inputs.viewmat, inputs.K))
        self.view = (viewmat, K, inputs.width, inputs.height)
        self.background = torch.from_numpy(inputs.background[None]).to(device, dtype)
        self.v_image = torch.from_numpy(inputs.v_image[None]).to(device, dtype)
        self.rasterize = rasterize
        self.work = (0, 0, 0)  # of the last pass: pairs, blocks, blocks with a change
        self.blended = 0  # (Gaussian, pixel) pairs of the last pass that was timed

    def run(self) -> torch.Tensor:
        """One pass; returns the image [1, H, W, 3], the gradients are in the leaves."""
        image, _, meta = self.rasterize(*self.leaves, *self.view, sh_degree=3, backgrounds=self.background)
        image.backward(self.v_image)
        self.work = meta.get("work", self.work)
        return image.detach()

    def __call__(self) -> Seconds:
        clock, composites = StageClock(), list[Any]()
        with one_torch_thread(), clock.watching(CRATE), _keeping(composites):
            seconds = clock.seconds(self.run, STAGES)
        self.clear()
        self.blended = sum(composite.blended for composite in composites)
        return seconds | {BIN: sum(composite.bin_seconds for composite in composites)}

    def clear(self) -> None:
        """Free the gradients, so that the many cases of a benchmark fit into memory together."""
        for leaf in self.leaves:
            leaf.grad = None


@contextmanager
def _keeping(composites: list[Any]) -> Iterator[None]:
    """Add to the list what the crate counts and times itself in each composite."""
    forward = getattr(*COMPOSITE)

    def call(*args: Any) -> Any:
        out = forward(*args)
        composites.append(out[0])
        return out

    with patch.object(*COMPOSITE, call):
        yield


def warmed(case: Callable[[], Seconds]) -> Callable[[], Seconds]:
    """The second of two passes in a row: as in training, its memory is what the one before gave back."""

    def call() -> Seconds:
        case()
        return case()

    return call


def measure(inputs: Sequence[RasterInputs], repeats: int) -> list[dict[str, Any]]:
    """Time and work of each of the inputs."""
    passes = [RasterPass(x) for x in inputs]
    measured = interleaved({str(k): warmed(case) for k, case in enumerate(passes)}, repeats)
    rows = []
    for x, case, rounds in zip(inputs, passes, measured.values(), strict=True):
        work = count_work(case.blended, x.width * x.height, *case.work)
        limit = work["limit_core_seconds"] / hqgs.get_num_threads()
        compositing = (rounds["bin and composite"] - rounds[BIN] + rounds["composite backward"]).median()
        rows.append(
            {"gaussians": len(x), "width": x.width, "height": x.height, **whole(rounds)}
            | {
                "stages": rounds[[*STAGES, "rest"]].median().to_dict(),
                "limit_seconds": limit,
                "times_limit": rounds["total"].median() / limit,
                "bin_seconds": rounds[BIN].median(),
                "compositing_seconds": compositing,
                "compositing_times_limit": compositing / limit,
                "work": work,
                "rounds": rounds.to_dict("records"),
            }
        )
    return rows


def thread_counts() -> list[int]:
    """1, 2, 4, ... up to the number of threads in use, which is the last."""
    most = hqgs.get_num_threads()
    return [*(1 << k for k in range(most.bit_length()) if 1 << k < most), most]


def measure_threads(cases: dict[str, Callable[[], Seconds]], repeats: int) -> list[dict[str, Any]]:
    """Each case with each number of threads; the speed-up is that of the same round."""
    threads = thread_counts()

    def with_threads(case: Callable[[], Seconds], count: int) -> Callable[[], Seconds]:
        def call() -> Seconds:
            hqgs.set_num_threads(count)
            return warmed(case)()  # new threads start with no memory of their own

        return call

    rows = []
    jobs = {f"{name}/{t}": with_threads(case, t) for name, case in cases.items() for t in threads}
    try:
        measured = interleaved(jobs, repeats)
    finally:
        hqgs.set_num_threads(threads[-1])
    for key, rounds in measured.items():
        name, count = key.rsplit("/", 1)
        line = {"case": name, "threads": int(count), "seconds": rounds["total"].median()}
        rows.append(line | {"speedup": median_ratio(measured[f"{name}/1"], rounds)})
    return rows
