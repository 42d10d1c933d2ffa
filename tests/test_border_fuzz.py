"""Every function of the binding with arrays that overlap, lie askew, stand still, are empty, huge or of
another shape: it takes them or says what is wrong, and never panics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_border import calls

from hqgs import _rust

CALLS = calls()
WRITTEN = {
    "adam_steps": ("param", "exp_avg", "exp_avg_sq"),
    "add_rows": ("sums",),
    "add_pulls": ("sums", "views"),
    "add_harmonics": ("high",),
}
REFUSALS = (ValueError, TypeError, OverflowError, MemoryError)  # a panic is none of them


NO_ARRAYS = {
    "Composite",
    "Exposure",
    "Frame",
    "get_num_threads",
    "give_back_memory",
    "set_num_threads",
    "simd_level",
}


def test_every_function_is_called() -> None:
    named = {call.split()[0] for call in CALLS}
    there = {name for name in dir(_rust) if callable(getattr(_rust, name)) and not name.startswith("_")}
    assert there == NO_ARRAYS | (named - {"apply", "apply_absolute"})


def of_call(call: str) -> dict[str, np.ndarray]:
    return {name: value for name, value in CALLS[call][1].items() if isinstance(value, np.ndarray)}


def misaligned(array: np.ndarray) -> np.ndarray:
    """The same numbers one byte after where they could lie."""
    memory = np.zeros(array.nbytes + 1 + array.itemsize, np.uint8)
    found = memory[1 : 1 + array.nbytes].view(array.dtype).reshape(array.shape)
    found[...] = array
    return found


def overlapping(array: np.ndarray, other: np.ndarray, shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Both over one memory, `array` so many bytes behind; as tensors over the same memory give them."""
    size = max(array.itemsize, other.itemsize)
    shift = min(shift * size, max(other.nbytes - 1, 0)) // size * size
    memory = torch.zeros(max(shift + array.nbytes, other.nbytes) // 8 * 8 + 16, dtype=torch.uint8)

    def at(begin: int, like: np.ndarray) -> np.ndarray:
        dtype = torch.from_numpy(like[:0].copy() if like.ndim else like.copy()).dtype
        part = memory[begin : begin + like.nbytes].view(dtype).view(like.shape)
        part.copy_(torch.from_numpy(like))
        return part.numpy()

    return at(shift, array), at(0, other)


@dataclass(frozen=True)
class Case:
    """One call with some of its arrays exchanged."""

    call: str
    how: str
    changed: dict[str, np.ndarray]
    names: tuple[str, ...]

    def run(self) -> Any:
        function, arguments = CALLS[self.call]
        fresh = {name: array.copy() for name, array in of_call(self.call).items()}
        return function(**{**arguments, **fresh, **self.changed})


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "misaligned": misaligned,
    "standing still": lambda a: np.broadcast_to(a.ravel()[0], a.shape),
    "empty": lambda a: a[:0].copy(),
    "empty in the last axis": lambda a: a[..., :0].copy(),
    "huge and empty": lambda a: np.empty((1 << 40, 0, *a.shape[2:]), a.dtype),
    "no axis": lambda a: a.ravel()[0].reshape(()),
    "one row more": lambda a: np.concatenate([a, a[:1]]),
    "flat": lambda a: a.reshape(-1),
    "turned": lambda a: np.ascontiguousarray(a.T),
    "turned, not copied": lambda a: a.T,
    "backwards": lambda a: a[::-1],
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape),
    "not a number": lambda a: np.full_like(
        a, np.nan if a.dtype.kind == "f" else np.array(-1).astype(a.dtype)
    ),
    "infinite": lambda a: np.full_like(a, np.inf if a.dtype.kind == "f" else np.iinfo(a.dtype).max),
    "enormous": lambda a: np.full_like(a, np.finfo(a.dtype).max if a.dtype.kind == "f" else 7),
    "tiny": lambda a: np.full_like(a, 1e-40 if a.dtype.kind == "f" else 1),
}


@st.composite
def cases(draw: st.DrawFn) -> Case:
    call = draw(st.sampled_from(sorted(CALLS)))
    arrays = of_call(call)
    name = draw(st.sampled_from(sorted(arrays)))
    how = draw(st.sampled_from(["overlapping", *CHANGES]))
    if how != "overlapping":
        return Case(call, how, {name: CHANGES[how](arrays[name])}, (name,))
    other = draw(st.sampled_from(sorted(arrays)))
    if other == name:
        return Case(call, how, {}, ())
    shift = draw(st.integers(0, 40))
    pair = overlapping(arrays[name], arrays[other], shift)
    return Case(call, how, dict(zip((name, other), pair, strict=True)), (name, other))


def check(case: Case) -> None:
    before = {name: array.copy() for name, array in case.changed.items()}
    written = WRITTEN.get(case.call, ())
    try:
        case.run()
    except REFUSALS:
        for name, array in case.changed.items():  # an in-place step that is refused has done nothing
            assert np.array_equal(array, before[name], equal_nan=array.dtype.kind == "f")
        return
    arrays = list(case.changed.values())
    shared = case.how == "overlapping" and len(arrays) == 2 and np.shares_memory(arrays[0], arrays[1])
    assert not (shared and set(case.names) & set(written)), case
    if case.how in ("misaligned", "standing still", "backwards"):
        changed = case.changed[case.names[0]]
        assert changed.size < 2 or (changed.flags.c_contiguous and changed.flags.aligned), case


# Building a case is slow on a busy machine.
EVERY_CHECK = [
    HealthCheck.too_slow,
    HealthCheck.filter_too_much,
    HealthCheck.data_too_large,
    HealthCheck.large_base_example,
]


@settings(max_examples=300, deadline=None, suppress_health_check=EVERY_CHECK)
@given(cases())
def test_any_array_is_taken_or_refused(case: Case) -> None:
    check(case)


@pytest.mark.slow
@settings(max_examples=10_000, deadline=None, suppress_health_check=EVERY_CHECK)
@given(cases())
def test_any_array_is_taken_or_refused_at_length(case: Case) -> None:
    check(case)


@pytest.mark.parametrize(
    ("call", "written", "other"),
    [
        (call, to, name)
        for call, names in WRITTEN.items()
        for to in names
        for name in of_call(call)
        if name != to
    ],
)
def test_what_is_written_shares_no_memory(call: str, written: str, other: str) -> None:
    arrays = of_call(call)
    pair = dict(zip((written, other), overlapping(arrays[written], arrays[other], 0), strict=True))
    before = {name: array.copy() for name, array in pair.items()}
    with pytest.raises(ValueError, match=r"^\w+: shares memory with \w+, which is written$"):
        Case(call, "overlapping", pair, (written, other)).run()
    for name, array in pair.items():
        assert np.array_equal(array, before[name])
