"""What a run is judged by."""

from __future__ import annotations

from typing import Any

import pytest

from hqgs.evaluation.verdict import judged_by, overdone, verdict


def report(gains: list[list[float]], aligned: float | None) -> dict[str, Any]:
    learned = [{"name": str(k), "gains": gain} for k, gain in enumerate(gains)]
    return {"metrics": {"mean": {"psnr": 21.0, "psnr_aligned": aligned}}, "learned": learned}


def test_brightness_is_set_aside_where_photos_were_exposed_each_in_its_own_way() -> None:
    same, own = [[1.0, 1.0, 1.0]] * 2, [[1.0, 1.0, 1.0], [1.3, 1.0, 0.9]]
    assert judged_by(report(same, 27.0)) == (21.0, "PSNR")
    assert judged_by(report(own, 27.0))[0] == 27.0
    assert "matched" in judged_by(report(own, 27.0))[1]
    assert judged_by(report(own, None)) == (21.0, "PSNR")
    assert judged_by({"metrics": {"mean": {"psnr": None}}}) == (None, "PSNR")


@pytest.mark.parametrize(
    ("psnr", "word"),
    [(19.99, "poor"), (20.0, "fair"), (25.0, "good"), (30.0, "very good"), (None, "not measured")],
)
def test_the_word_rises_with_the_psnr(psnr: float | None, word: str) -> None:
    assert verdict(psnr)[0] == word


def test_the_verdict_goes_by_the_look_of_the_photos_cameras() -> None:
    """Gains alike for all photos are the scene's brightness, and no exposure of their own."""
    measured = {"mean": {"psnr": 25.1, "psnr_aligned": 25.6}, "psnr_shown": 21.6, "views": []}
    psnr, name = judged_by({"metrics": measured, "learned": 3 * [{"gains": [1.1, 1.1, 1.1]}]})
    assert psnr == 25.1
    assert "21.6 dB without" in name


def moments(*values: tuple[float | None, float | None], views: int | None = None) -> list[Any]:
    more = {} if views is None else {"views": views}
    return [
        {"iteration": 100 * k, "seconds": k, "psnr": psnr, "ssim": ssim, **more}
        for k, (psnr, ssim) in enumerate(values, 1)
    ]


def test_a_run_that_ends_below_its_best_is_told() -> None:
    fell = moments((20.0, 0.5), (22.5, 0.7), (22.0, 0.69))
    told = overdone(fell)
    assert told is not None
    assert "after iteration 200, 0.5 dB better than at the end" in told
    assert overdone(moments((20.0, 0.5), (22.05, 0.71), (22.0, 0.7))) is None  # two seeds differ by more
    assert overdone(moments((22.5, 0.6), (22.0, 0.7))) is None  # darker, say, and yet more like the photos
    assert overdone(moments((22.5, 0.7), (None, None))) is None
    assert overdone([]) is None
    assert overdone([*moments((22.5, 0.7), views=2), *moments((20.0, 0.5))]) is None  # of other photos
