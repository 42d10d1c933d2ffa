"""Counts of the work that was done, so that a test can say that what nobody asked for was left out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np


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


_open: list[WorkCounts] = []


@contextmanager
def work_counts() -> Iterator[WorkCounts]:
    """Count what `rasterization`, its backward pass and `hqgs.optim.Adam` do inside the `with` block.

        with work_counts() as counts:
            image, _, _ = rasterization(...)
            image.sum().backward()
        assert counts.backward_gaussians == ...

    The crate counts in any case, a few additions for each tile and each group of Gaussians; outside of a
    block nobody adds the counts up. Blocks may be nested: each counts everything inside it, from all threads.
    """
    counts = WorkCounts()
    _open.append(counts)
    try:
        yield counts
    finally:
        _open.remove(counts)


def is_counting() -> bool:
    """Whether a block is open: otherwise there is no need to look at the counts."""
    return bool(_open)


def add_counts(more: Mapping[str, int]) -> None:
    """Add to the open blocks."""
    for counts in _open:
        for name, value in more.items():
            setattr(counts, name, getattr(counts, name) + value)


def add_gradients(arrays: Iterable[np.ndarray[Any, Any] | None], more: Mapping[str, int]) -> None:
    """Add the arrays that a backward pass made, and what the crate counted meanwhile."""
    made = [array.size for array in arrays if array is not None]
    add_counts({**more, "gradient_arrays": len(made), "gradient_numbers": sum(made)})
