"""Timing on a machine that does other things too: interleaved rounds, medians, ratios within a round."""

from __future__ import annotations

import gc
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np
from pandas import DataFrame

import hqgs

Case = TypeVar("Case", bound=Hashable)
Seconds = dict[str, float]  # by stage; "total" is the whole, and what no stage holds is "rest"


def interleaved(cases: Mapping[Case, Callable[[], Seconds]], repeats: int) -> dict[Case, DataFrame]:
    """Call each case once to warm up, then all of them in each of `repeats` rounds, which are the rows.

    What disturbs the machine for a while then disturbs all cases alike. Every other round goes backwards.
    """
    measured: dict[Case, list[Seconds]] = {name: [] for name in cases}
    for case in cases.values():
        case()
    collecting = gc.isenabled()
    gc.disable()
    try:
        for k in range(repeats):
            for name in list(cases)[:: -1 if k % 2 else 1]:
                measured[name].append(cases[name]())
    finally:
        if collecting:
            gc.enable()
    return {name: DataFrame(rounds) for name, rounds in measured.items()}


def warmed(case: Callable[[], Seconds], context: Callable[[], Any] = nullcontext) -> Callable[[], Seconds]:
    """The second of two calls in a row, inside the context: as in training, its memory is what the one before
    gave back, and threads that the context makes start with none of their own."""

    def call() -> Seconds:
        with context():
            case()
            return case()

    return call


@contextmanager
def using_threads(count: int) -> Iterator[None]:
    """Inside it the crate has this many threads."""
    before = hqgs.get_num_threads()
    hqgs.set_num_threads(count)
    try:
        yield
    finally:
        hqgs.set_num_threads(before)


def quartiles(values: Any) -> list[float]:
    """The values below which a quarter and three quarters of them lie."""
    return np.quantile(values, [0.25, 0.75]).tolist()


def median_ratio(rounds: DataFrame, others: DataFrame) -> float:
    """Median over the rounds of the ratio of two cases: what slows both down in a round cancels."""
    return float((rounds["total"] / others["total"]).median())


def whole(rounds: DataFrame) -> dict[str, float]:
    """Median and quartiles of the whole, as columns."""
    low, high = quartiles(rounds["total"])
    return {"seconds": float(rounds["total"].median()), "seconds_low": low, "seconds_high": high}


class StageClock:
    """Seconds by stage of what runs inside `watching`; a stage does not count the stages within it."""

    def __init__(self, keep: str = "") -> None:
        self.keep, self.kept = keep, list[Any]()  # a stage, and what its functions returned
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._inner: list[float] = []  # of each open stage, the seconds of the stages within it

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, with its time added to `stage`."""

        def call(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            started = time.perf_counter()
            try:
                returned = function(*args, **kwargs)
                if stage == self.keep:
                    self.kept.append(returned)
                return returned
            finally:
                spent = time.perf_counter() - started
                self._seconds[stage] += spent - self._inner.pop()
                if self._inner:
                    self._inner[-1] += spent

        return call

    @contextmanager
    def watching(self, stages: Mapping[tuple[Any, str], str]) -> Iterator[None]:
        """Time functions in the place where their callers find them: class or module, and name."""
        with ExitStack() as stack:
            for place, stage in stages.items():
                stack.enter_context(patch.object(*place, self.timed(stage, getattr(*place))))
            yield

    def seconds(self, function: Callable[[], Any], stages: Iterable[str]) -> Seconds:
        """Run `function` and return its total, the stages in it (0 for those not reached) and the rest."""
        self._seconds.clear()
        self.timed("rest", function)()
        found = {stage: self._seconds[stage] for stage in [*stages, "rest"]}
        return {"total": sum(self._seconds.values()), **found}
