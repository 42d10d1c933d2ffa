"""The benchmark `intervals`: how often an interval holds the mean of all photos."""

from __future__ import annotations

import numpy as np

from benchmarks.intervals import held


def test_draws_whose_interval_holds_are_counted() -> None:
    values = np.array([0.0, 1.0, 2.0, 3.0])  # their mean is 1.5
    draws = [np.array(pair) for pair in ([0, 1], [0, 3], [2, 3], [1, 2])]  # means .5, 1.5, 2.5, 1.5
    assert held(draws, values, lambda some: 0.1) == (0.5, 0.1)
    assert held(draws, values, lambda some: 1.0) == (1.0, 1.0)
    share, half = held(draws, values, lambda some: max(some) - min(some))
    assert (share, half) == (1.0, 1.5)
    assert held(draws, values, lambda some: None) == (0.5, 0.0)
