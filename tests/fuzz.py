"""Seeded mutations of files, and a child process in which a loader may crash or use too much memory."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import struct
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext
from pathlib import Path

import numpy as np

PHOTO = re.compile(r"photo '(images/)?view_0\d\.\w+'")  # what an error may name instead of the file
HUGE = [10**12, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1]
TOKENS = [
    b"-1", b"0", b"1e999", b"-1e999", b"nan", b"NaN", b"Infinity", b"inf", b"1e308", b"1e-320", b"1e20",
    b"1000000000000", b"18446744073709551616", b"9" * 400, b"0x10", b"", b"null", b"[]", b"{}", b'""',
    b"true", b'"../../x"', b'"/etc/passwd"', b"\xff\xfe", b"\x00", b"\xf0\x9f\x92\xa9", b"[" * 3_000,
]  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A loader with a whole folder, and the file in it that is to be mutated."""

    name: str
    root: Path
    file: str
    load: Callable[[Path], None]  # of the root; checks what it gets
    text: bool = False
    memory: int = 1 << 30  # bytes that loading may take beyond what the process has


def mutations(whole: bytes, text: bool, count: int, seed: int) -> list[tuple[str, bytes]]:
    """Cuts at regular places, then `count` random changes, each with a description."""
    rng = np.random.default_rng(seed)
    cuts = sorted({*range(min(len(whole), 24)), *np.linspace(0, len(whole) - 1, 40).astype(int).tolist()})
    made = [(f"cut at {at}", whole[:at]) for at in cuts]
    kinds = [_flip, _huge, _fill, _repeat, _remove, *([_token] * 5 if text else [])]
    while len(made) < count + len(cuts):
        data = bytearray(whole)
        names = []
        for _ in range(int(rng.integers(1, 4))):
            kind = kinds[rng.integers(len(kinds))]
            names.append(kind(data, rng))
        made.append((", ".join(names), bytes(data)))
    return made


def _place(data: bytearray, rng: np.random.Generator) -> int:
    """Headers are hit as often as the rest."""
    reach = min(len(data), 64) if rng.random() < 0.5 else len(data)
    return int(rng.integers(max(reach, 1)))


def _flip(data: bytearray, rng: np.random.Generator) -> str:
    at, bit = _place(data, rng), int(rng.integers(8))
    if data:
        data[at] ^= 1 << bit
    return f"bit {bit} of byte {at} flipped"


def _huge(data: bytearray, rng: np.random.Generator) -> str:
    at, value = _place(data, rng), HUGE[rng.integers(len(HUGE))]
    size = int(rng.choice([4, 8]))
    data[at : at + size] = struct.pack("<Q", value)[:size]
    return f"{value} in {size} bytes at {at}"


def _fill(data: bytearray, rng: np.random.Generator) -> str:
    at, length, value = _place(data, rng), int(rng.integers(1, 17)), int(rng.choice([0, 255, 0x7F]))
    data[at : at + length] = bytes([value]) * len(data[at : at + length])
    return f"{length} bytes of {value} at {at}"


def _repeat(data: bytearray, rng: np.random.Generator) -> str:
    at, length = _place(data, rng), int(rng.integers(1, 65))
    data[at:at] = data[at : at + length]
    return f"{length} bytes at {at} twice"


def _remove(data: bytearray, rng: np.random.Generator) -> str:
    at, length = _place(data, rng), int(rng.integers(1, 65))
    del data[at : at + length]
    return f"{length} bytes at {at} gone"


def _token(data: bytearray, rng: np.random.Generator) -> str:
    words = list(re.finditer(rb"[^\s,:\[\]{}]+", data))
    if not words:
        return "no word left"
    word, token = words[rng.integers(len(words))], TOKENS[rng.integers(len(TOKENS))]
    data[word.start() : word.end()] = token
    return f"{bytes(word[0])[:20]!r} at {word.start()} is {token[:20]!r}"


def run_in_child(processes: ForkServerContext, target: Target, cases: list[tuple[str, bytes]]) -> list[str]:
    """Load each case; what was wrong with which. A crash or a hang ends the list."""
    log = target.root.parent / f"{target.name}.log"
    child = processes.Process(target=_load_all, args=(target, cases, log))
    child.start()
    child.join(300)
    if child.is_alive():
        child.kill()
        child.join()
    records = [json.loads(line) for line in log.read_text().splitlines()]
    wrong = [f"{r['case']}: {r['wrong']}" for r in records if r["wrong"]]
    if child.exitcode != 0:
        code = child.exitcode or 0
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        wrong.append(f"{cases[len(records)][0]}: the process ended with {how}")
    return wrong


def _load_all(target: Target, cases: list[tuple[str, bytes]], log: Path) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries in C++ complain there
    target.load(target.root)  # also makes the threads there will be
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + target.memory, resource.RLIM_INFINITY))
    path = target.root / target.file
    with log.open("w") as records:
        for case, content in cases:
            path.write_bytes(content)
            record = {"case": case, "wrong": judge(target)}
            records.write(json.dumps(record) + "\n")
            records.flush()


def judge(target: Target) -> str | None:
    """None where the file is loaded or refused with its name; else what happened."""
    try:
        target.load(target.root)
    except (ValueError, OSError) as error:
        named = str(target.root) in str(error) or PHOTO.search(str(error))
        if isinstance(error, UnicodeError) or not named:
            return f"the message does not name the file: {type(error).__name__}: {error}"
        return None
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    return None
