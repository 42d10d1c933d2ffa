"""Work on several threads; torch's own, which its results depend on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from hqgs._rust import get_num_threads

S = TypeVar("S")
T = TypeVar("T")


def of_each(work: Callable[[S], T], items: Iterable[S], most: int = 1_000) -> Iterator[T]:
    """What `work` makes of each item, in their order, on the rasterizer's number of threads, or `most`."""
    with ThreadPoolExecutor(min(get_num_threads(), most)) as pool:
        yield from pool.map(work, items)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch's sums depend on its number of threads, which spin for a while after each work, on cores that the
    rasterizer's threads could have. The rasterizer's sums do not; it keeps all of its threads."""
    import torch  # here, since the rest of this file loads nothing

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
