"""Some of many, evenly spread."""

from __future__ import annotations

import numpy as np


def evenly(count: int, most: int) -> list[int]:
    """Numbers, rising, of at most `most` of `count` things in a row: the first, the last and some between."""
    if count <= 0:
        return []
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def middles(count: int, most: int) -> list[int]:
    """Numbers, rising, of at most `most` of `count` things in a row: the middles of as many equal parts."""
    most = min(count, most)
    return np.linspace(0, count, 2 * most + 1)[1::2].astype(int).tolist()
