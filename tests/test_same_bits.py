"""A few of the runs of same_bits.py, which has all of them and says how their hashes are recorded."""

from __future__ import annotations

import pytest
from same_bits import CASES, STOPPED, key, recorded, trained


@pytest.mark.parametrize("name", ["tiny 3dgs", "auto few points", "hqgs exposure batch"])
def test_a_run_has_the_recorded_bits_stopped_or_not(name: str) -> None:
    case, known = CASES[name], recorded().get(name)
    found = trained(case)
    assert trained(case, STOPPED) == found
    if known is None:
        pytest.skip(f"resumed alike, but there is no record for {key()}")
    assert found == known


def test_other_runs_have_other_bits() -> None:
    """Else the hash would not tell."""
    names = ("3dgs", "3dgs some", "3dgs batch", "srgs", "paper", "hqgs noise:12", "hqgs jpeg:20")
    known = recorded()
    found = [known[name] for name in names] if known else [trained(CASES[name]) for name in names[:3]]
    assert len(set(found)) == len(found)
