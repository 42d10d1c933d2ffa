"""The benchmark of steps of several views."""

from __future__ import annotations

from typing import Any

import pytest
from pandas import DataFrame

from benchmarks.ranks import PROTOCOLS, lines


def one(row: str, psnr: float, seed: int = 0) -> dict[str, Any]:
    return {
        "scene": "desk",
        "row": row,
        "seed": seed,
        "seconds": 10.0,
        "gaussians": 100,
        "psnr": psnr,
        "ssim": 0.9,
    }


def test_rows_are_compared_with_one_view_a_step_of_the_same_seeds() -> None:
    runs = DataFrame([one("1", 30.0), one("1", 40.0, seed=1), one("4", 29.9), one("8", 29.0)])
    first, four, eight = lines(runs)
    assert (first["psnr"], first["difference"]) == (35.0, 0.0)
    assert four["difference"] == pytest.approx(-0.1)
    assert eight["difference"] == -1.0
    (alone,) = lines(DataFrame([one("4", 29.9)]))
    assert alone["difference"] is None


def test_a_row_is_so_many_views_a_step() -> None:
    protocol = PROTOCOLS["standard"]
    assert {row.label: protocol.train_config(row, 0).batch for row in protocol.rows} == {
        "1": 1,
        "2": 2,
        "4": 4,
        "8": 8,
    }
