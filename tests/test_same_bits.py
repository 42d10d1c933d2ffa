"""A few of the runs of same_bits.py, which has all of them and says how their hashes are recorded."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import same_bits
from same_bits import CASES, STOPPED, key, recorded, trained


@pytest.mark.parametrize("name", ["tiny 3dgs", "auto few points", "hqgs exposure batch"])
def test_a_run_has_the_recorded_bits_stopped_or_not(name: str) -> None:
    case, known = CASES[name], recorded().get(name)
    found = trained(case)
    assert trained(case, STOPPED) == found
    if known is None:
        pytest.skip(f"resumed alike, but there is no record for {key()}")
    assert found == known


def test_another_make_of_cpu_has_the_same_bits() -> None:
    """MKL and OpenBLAS are told to take what they have for other CPUs, which rounds otherwise."""
    other = os.environ | {"MKL_CBWR": "COMPATIBLE", "OPENBLAS_CORETYPE": "Haswell"}
    names = ["auto few points", "hqgs exposure"]
    command = [sys.executable, same_bits.__file__, *names]
    told = subprocess.run(command, env=other, capture_output=True, text=True, check=False).stdout
    assert [line.split()[0] for line in told.splitlines()] == [trained(CASES[name]) for name in names]


def test_other_runs_have_other_bits() -> None:
    """Else the hash would not tell."""
    names = ("3dgs", "3dgs some", "3dgs batch", "srgs", "paper", "hqgs noise:12", "hqgs jpeg:20")
    known = recorded()
    found = (
        [known[name] for name in names if name in known]
        if known
        else [trained(CASES[name]) for name in names[:3]]
    )
    assert len(set(found)) == len(found)
