"""The processes of one run: what each tells the others, and how they end together.

torch.distributed carries it (gloo), under torchrun. A thread of its own does the talking, so that it goes on
while the rank computes, and so that silence means that a rank has gone.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")
# s without a word after which a rank counts as gone: torchrun takes up to 30 more to end a process that was
# stopped, and all is to be over within a minute.
SILENCE = 25.0
HEARTBEAT = SILENCE / 5  # s: a rank that has nothing to say yet says so as often
PIECE = 1 << 24  # bytes that are sent at once: on a slow network a long message is no silence
NOTHING, DATA, FAILED, END = range(4)  # what a rank has to say in a round


class RankError(RuntimeError):
    """Another process of the run has failed or gone; the message says which, and why if it could tell."""


class Ranks:
    """The processes of a run, `count` of them, of which this one has the number `rank`. Here: it is alone."""

    rank: int = 0
    count: int = 1
    local: int = 1  # of them on this machine

    def __init__(self) -> None:
        self.count_anew()

    def count_anew(self) -> None:
        """What `record` tells begins now."""
        self.worked: float = 0.0  # s, on its share of the views
        self.waited: float = 0.0  # s, for others
        self.sent: int = 0  # bytes

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and tells the user."""
        return self.rank == 0

    def begin(self, mine: bytes) -> Callable[[], list[bytes]]:
        """Send `mine` to all; the function that it returns waits for what each rank has sent, in their order.

        Every rank makes the same calls in the same order; it goes on computing between the two.
        """
        return lambda: [mine]

    def tell(self, value: Any) -> list[Any]:
        """What each rank gives, JSON values, in their order."""
        if self.count == 1:
            return [value]
        return [json.loads(said) for said in self.begin(json.dumps(value).encode())()]

    def divide(self, items: Sequence[T], work: Callable[[T], Any]) -> list[Any]:
        """`work` of each item, JSON values in their order; item k is done by rank k mod `count`."""
        every = self.tell([work(item) for item in items[self.rank :: self.count]])
        return [every[k % self.count][k // self.count] for k in range(len(items))]

    def agree(self, value: object, what: str) -> None:
        """RankError where this is not the same on every rank."""
        if self.count == 1:
            return
        values = self.tell(str(value))
        if other := [k for k, there in enumerate(values) if there != values[0]]:
            raise RankError(
                f"{what} of rank {other[0]} differs from rank 0's: all need the same photos, the same hqgs "
                "and the same kind of CPU (HQGS_SIMD)"
            )

    def record(self) -> dict[str, Any]:
        """What this rank has done since, as the report has it."""
        return {
            "rank": self.rank,
            "view_seconds": self.worked,
            "waiting_seconds": self.waited,
            "sent_bytes": self.sent,
        }

    def fail(self, why: str) -> None:
        """Tell the others that this rank has failed."""

    def end(self) -> None:
        """Wait until every rank has come to its end."""


ALONE = Ranks()


@dataclass
class _Item:
    kind: int
    data: bytes = b""
    answer: Future[list[bytes]] = field(default_factory=Future)


class _Joined(Ranks):
    """One of several. The rounds of its thread: each rank says what it has; where all have data it is
    exchanged, where one has failed the others are told."""

    def __init__(self) -> None:
        import torch  # here: seconds of loading for those who need it
        import torch.distributed as dist
        from torch.distributed.distributed_c10d import PrefixStore
        from torch.distributed.rendezvous import rendezvous

        super().__init__()
        self._dist, self._torch = dist, torch
        for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
            if not os.environ.get(name):
                raise ValueError(f"{name} is not set: start several processes with torchrun")
        store, self.rank, self.count = next(rendezvous("env://", timeout=timedelta(seconds=SILENCE)))
        # torchrun's store outlives a restart, with the addresses of those who were there before.
        store = PrefixStore(f"start {restarts()}", store)
        dist.init_process_group(
            "gloo", store=store, rank=self.rank, world_size=self.count, timeout=timedelta(seconds=SILENCE)
        )
        self.local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        self._others = [k for k in range(self.count) if k != self.rank]
        self._items: queue.Queue[_Item] = queue.Queue()
        self._failure: bytes | None = None
        self._thread = threading.Thread(target=self._serve, name="ranks", daemon=True)
        self._thread.start()

    def begin(self, mine: bytes) -> Callable[[], list[bytes]]:
        item = _Item(DATA, mine)
        self._items.put(item)

        def answer() -> list[bytes]:
            started = time.perf_counter()
            try:
                return item.answer.result()
            finally:
                self.waited += time.perf_counter() - started

        return answer

    def fail(self, why: str) -> None:
        self._failure = why.encode()
        self._items.put(_Item(FAILED))
        self._thread.join(2 * HEARTBEAT)

    def end(self) -> None:
        item = _Item(END)
        self._items.put(item)
        item.answer.result()
        self._thread.join()
        self._dist.destroy_process_group()

    def _serve(self) -> None:
        error: Exception | None = None
        item: _Item | None = None
        while error is None:
            if item is None:
                with suppress(queue.Empty):
                    item = self._items.get(timeout=HEARTBEAT)
            try:
                if self._round(item):
                    if item is not None and item.kind == END:
                        return
                    item = None
            except Exception as found:  # whatever it is, whoever waits must hear of it
                error = found
        while True:  # nobody may wait for ever
            if item is not None:
                item.answer.set_exception(error)
            item = self._items.get()

    def _round(self, item: _Item | None) -> bool:
        """Whether `item` is done with."""
        torch = self._torch
        kind, data = (NOTHING, b"") if item is None else (item.kind, item.data)
        if self._failure is not None:
            kind, data = FAILED, self._failure
        heads = {self.rank: (kind, len(data))}
        mine = torch.tensor([kind, len(data)])
        others = {k: torch.empty(2, dtype=torch.int64) for k in self._others}
        self._swap({k: mine for k in self._others}, others)
        heads |= {k: (int(head[0]), int(head[1])) for k, head in others.items()}
        kinds = {head[0] for head in heads.values()}
        if FAILED not in kinds and NOTHING in kinds:
            return False
        if FAILED not in kinds and len(kinds) > 1:
            raise RankError("the ranks do not do the same: all need the same command and the same hqgs")
        failed = FAILED in kinds
        talks = {k for k, head in heads.items() if head[1] and (not failed or head[0] == FAILED)}
        out = torch.frombuffer(bytearray(data), dtype=torch.uint8) if self.rank in talks else mine[:0]
        others = {k: torch.empty(heads[k][1], dtype=torch.uint8) for k in self._others if k in talks}
        for at in range(0, max((heads[k][1] for k in talks), default=0), PIECE):
            piece = slice(at, at + PIECE)
            ins = {k: tensor[piece] for k, tensor in others.items() if at < len(tensor)}
            self._swap({k: out[piece] for k in self._others if at < len(out)}, ins)
        said = {k: tensor.numpy().tobytes() for k, tensor in others.items()} | {self.rank: data}
        if failed:
            k = min(k for k, head in heads.items() if head[0] == FAILED)
            raise RankError(f"rank {k} failed: {said[k].decode()}")
        if item is not None:
            item.answer.set_result([said.get(k, b"") for k in range(self.count)])
        return True

    def _swap(self, outs: dict[int, Tensor], ins: dict[int, Tensor]) -> None:
        """Send and receive with each of the others at once."""
        receive, send = self._dist.irecv, self._dist.isend
        works = [(k, _heard(k, lambda k=k, t=tensor: receive(t, src=k))) for k, tensor in ins.items()]
        works += [(k, _heard(k, lambda k=k, t=tensor: send(t, dst=k))) for k, tensor in outs.items()]
        self.sent += sum(tensor.nbytes for tensor in outs.values())
        for k, work in works:
            assert work is not None  # this rank is of the group
            _heard(k, work.wait)


def _heard(rank: int, call: Callable[[], T]) -> T:
    """What a call that needs another rank gives; RankError where that one has gone."""
    try:
        return call()
    except RuntimeError as error:
        silent = f"did not answer for {SILENCE:.0f} s" if "imed out" in str(error) else "has gone"
        raise RankError(f"rank {rank} {silent}: it was stopped, or its machine was cut off") from error


@contextmanager
def joined() -> Iterator[Ranks]:
    """The ranks that torchrun has started, or this process alone. What fails on one ends all of them."""
    if int(os.environ.get("WORLD_SIZE") or 1) < 2:
        yield ALONE
        return
    try:
        ranks = _Joined()
    except RuntimeError as error:
        raise RankError(f"the ranks did not find each other: {' '.join(str(error).split())[:200]}") from error
    try:
        yield ranks
    except KeyboardInterrupt:
        ranks.fail("it was stopped")
        raise
    except Exception as error:
        if threading.current_thread() is threading.main_thread():
            # torchrun ends a rank as soon as another one has failed; this one is to say why, and then ends.
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if not isinstance(error, RankError):
            ranks.fail(str(error))
        raise
    else:
        ranks.end()


def restarts() -> int:
    """How often torchrun has started this process in the place of one that failed."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT") or 0)
