"""The benchmark of error against seconds."""

from __future__ import annotations

from typing import Any

from pandas import DataFrame

from benchmarks.time import FIRST, levels, lines, then


def one(row: str, seconds: float, psnr: float, **more: Any) -> dict[str, Any]:
    means = {
        "seconds": seconds,
        "iterations": 100,
        "gaussians": 10,
        "psnr": psnr,
        "ssim": 0.9,
        "haarpsi": 0.9,
    }
    return {"scene": "desk", "row": row, "history": []} | means | more


HISTORY = [{"seconds": 9.0, "psnr": 20.0}, {"seconds": 31.0, "psnr": 25.0}, {"seconds": 90.0, "psnr": 28.0}]


def test_the_reference_is_what_was_known_then() -> None:
    assert then(HISTORY, 5.0) is None
    assert then(HISTORY, 30.0) == 20.0
    assert then(HISTORY, 31.0) == 25.0


def test_lines_and_levels_by_hand() -> None:
    reference = one("3dgs", 100.0, 28.0, history=HISTORY)
    seeds = [one("30 s", 29.0, 26.0), one("30 s", 31.0, 27.0)]
    runs = DataFrame([reference, *seeds, one("60 s", 61.0, 27.95), one("30 s, own points", 30.0, 24.0)])
    earlier = [{"seconds": 20.0, "psnr": 22.0}], [{"seconds": 30.0, "psnr": 24.0}]
    first, second = lines(runs, {FIRST: {"desk": earlier}})
    assert (first["first"], first["gain"]) == (23.0, 3.5)
    assert (first["asked"], first["seconds"], first["psnr"]) == (30.0, 30.0, 26.5)
    assert (first["own"], first["reference"]) == (24.0, 20.0)
    assert (second["own"], second["reference"]) == (None, 25.0)
    assert levels(runs) == ["desk: 27.90 dB take 61 s, 3dgs 100 s to its end."]
    (alone,) = lines(DataFrame([one("30 s", 29.0, 26.0)]), {})
    assert alone["reference"] is None  # 3dgs is not finished there
    assert alone["gain"] is None
    (short,) = levels(DataFrame([reference, *seeds]))
    assert "more than were tried" in short
