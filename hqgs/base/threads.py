"""Torch's own threads, which its results depend on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch's sums depend on its number of threads, which spin for a while after each work, on cores that the
    rasterizer's threads could have. The rasterizer's sums do not; it keeps all of its threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
