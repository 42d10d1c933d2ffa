"""Counts of the work that was done, so that a test can say that what nobody asked for was left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from hqgs import _rust


@dataclass(eq=False)
class WorkCounts:
    """Sums over all cameras and calls. The crate's own counts are explained in rust/counts.rs."""

    # Projection.
    gaussians: int = 0  # given to it
    projected: int = 0  # of them kept; the others are culled
    harmonics: int = 0  # basis functions evaluated, one for each Gaussian and function; in groups of 16
    slopes: int = 0  # Gaussians whose colours' derivatives were kept; in groups of 16
    # Compositing.
    tiles: int = 0  # with Gaussians
    channels: int = 0  # of the images
    pairs: int = 0  # (Gaussian, tile)
    blocks: int = 0  # (Gaussian, block of 4 x 4 pixels)
    changed_blocks: int = 0  # of them those in which a pixel changed
    blended: int = 0  # (Gaussian, pixel)
    # Its backward pass.
    backward_tiles: int = 0  # with Gaussians, replayed
    skipped_tiles: int = 0  # with Gaussians, left out: all cotangents are 0
    backward_blocks: int = 0  # (Gaussian, block) pairs, replayed
    skipped_blocks: int = 0  # left out: all cotangents of the block are 0
    alpha_cotangents: int = 0  # pixels in which the cotangent of alpha was read
    # The backward pass of the projection.
    backward_gaussians: int = 0  # whose geometry was differentiated; in groups of 16
    backward_harmonics: int = 0  # basis functions differentiated
    # Both backward passes.
    gradient_arrays: int = 0
    gradient_numbers: int = 0  # in these arrays
    # Adam.
    adam_numbers: int = 0  # parameters updated

    def add(self, more: dict[str, int]) -> None:
        for name, value in more.items():
            setattr(self, name, getattr(self, name) + value)


def _of_forward(found: Any, arguments: tuple[Any, ...]) -> dict[str, int]:
    return found[0].counts


def _of_backward(found: Any, arguments: tuple[Any, ...]) -> dict[str, int]:
    """What the crate counted, and the arrays that the backward pass made."""
    *arrays, counts = found
    made = [array.size for array in arrays if array is not None]
    return {**counts, "gradient_arrays": len(made), "gradient_numbers": sum(made)}


def _of_adam(found: Any, arguments: tuple[Any, ...]) -> dict[str, int]:
    moved = [
        param.size if used is None else param.size // param.shape[1] * used
        for param, *_, used in arguments[0]
    ]
    return {"adam_numbers": sum(moved)}


COUNTED: dict[str, Callable[[Any, tuple[Any, ...]], dict[str, int]]] = {
    "project_forward": _of_forward,
    "composite_forward": _of_forward,
    "project_backward": _of_backward,
    "composite_backward": _of_backward,
    "adam_steps": _of_adam,
}


@contextmanager
def work_counts() -> Iterator[WorkCounts]:
    """Count what the rasterizer, its backward pass and Adam do inside the `with` block.

        with work_counts() as counts:
            image, _, _ = rasterization(...)
            image.sum().backward()
        assert counts.backward_gaussians == ...

    The crate counts in any case; the block reads the counts from what its functions return. Blocks may be
    nested: each counts everything inside it, from all threads.
    """
    counts = WorkCounts()
    with pytest.MonkeyPatch.context() as patch:
        for name, counts_of in COUNTED.items():
            patch.setattr(_rust, name, _counting(getattr(_rust, name), counts_of, counts))
        yield counts


def _counting(function: Any, counts_of: Any, counts: WorkCounts) -> Callable[..., Any]:
    def counting(*arguments: Any) -> Any:
        found = function(*arguments)
        counts.add(counts_of(found, arguments))
        return found

    return counting
