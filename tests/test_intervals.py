"""Intervals of means over photos, and of differences of two scenes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter

from benchmarks.scenes.room.shading import render_view
from benchmarks.scenes.sparse import ARC, HIGH, LOW, camera_on_arc
from hqgs.evaluation.constants import CONFIDENCE
from hqgs.evaluation.intervals import SPREAD_LOGS, SPREADS, difference, half_width, with_half
from hqgs.evaluation.metrics import psnr


def test_it_is_the_interval_of_student() -> None:
    values = np.random.default_rng(0).normal(25, 2, 9)
    low, high = stats.t.interval(CONFIDENCE, 8, values.mean(), stats.sem(values))
    half = half_width(values.tolist())
    assert half is not None
    assert (values.mean() - half, values.mean() + half) == pytest.approx((low, high))


def test_photos_that_happen_to_agree_are_held_against_other_scenes() -> None:
    """Against draws of a scene's deviation, of a mean, and of photos, weighted by what the photos show."""
    rng, count, seen = np.random.default_rng(3), 3, 0.4
    sigmas = SPREADS["psnr"] * np.exp(rng.normal(0, SPREAD_LOGS, 400_000))
    weights = sigmas ** -(count - 1.0) * np.exp(-(count - 1) * (seen / sigmas) ** 2 / 2)
    away = np.abs(rng.normal(0, sigmas / np.sqrt(count)))
    order = np.argsort(away)
    shares = np.cumsum(weights[order]) / weights.sum()
    wanted = away[order][np.searchsorted(shares, CONFIDENCE)]
    values = (25 + seen * np.array([-1, 0, 1])).tolist()
    assert half_width(values, "psnr") == pytest.approx(wanted, rel=0.02)
    student = half_width(values)
    assert student is not None
    assert student < wanted
    assert half_width(values, "lpips") == student
    many = rng.normal(25, 2, 40).tolist()
    assert half_width(many, "psnr") == pytest.approx(half_width(many), rel=0.02)


def test_there_is_none_where_photos_do_not_tell() -> None:
    assert half_width([25.0]) is None
    assert half_width([25.0, None, 26.0]) is None
    assert half_width([]) is None
    assert difference([1.0, None], [2.0, 3.0]) is None
    assert with_half(25.0, None, ".2f") == "25.00"
    assert with_half(0.5, 0.125, "+.2f") == "+0.50 ± 0.12"


def test_a_difference_is_paired() -> None:
    """Hard photos are hard for both scenes: 0.1 dB between them is sure, though photos differ by 10 dB."""
    rng = np.random.default_rng(1)
    hard = rng.uniform(20, 30, 8)
    one, other = hard + 0.1 + rng.normal(0, 0.02, 8), hard
    apart = difference(one.tolist(), other.tolist())
    assert apart is not None
    assert apart.sure
    assert apart.mean == pytest.approx(0.1, abs=0.03)
    alone = half_width(hard.tolist())
    assert alone is not None
    assert alone > 1
    noisy = difference((hard + rng.normal(0, 1, 8)).tolist(), other.tolist())
    assert noisy is not None
    assert not noisy.sure
    single = difference([25.0], [24.0])
    assert single is not None
    assert not single.sure


def test_intervals_cover_what_they_say() -> None:
    """Of photos whose values are known to be normal."""
    rng = np.random.default_rng(2)
    for photos in (2, 3, 8):
        draws = rng.normal(25, 2, (1000, photos))
        halves = np.array([half_width(draw.tolist()) for draw in draws])
        assert np.mean(np.abs(draws.mean(1) - 25) <= halves) == pytest.approx(CONFIDENCE, abs=0.03)


@pytest.mark.slow
def test_intervals_of_psnr_cover_the_room() -> None:
    """200 draws of held-out photos of the room, of a scene that is its photos blurred and noisy."""
    rng, values = np.random.default_rng(0), []
    for _ in range(120):
        camera = camera_on_arc(rng.uniform(-ARC, ARC), rng.uniform(HIGH, LOW), rng.uniform(-1, 1, 7), 128, 96)
        photo = render_view(camera)
        blurred = gaussian_filter(photo / 255.0, (1.2, 1.2, 0)) + rng.normal(0, 0.02, photo.shape)
        values.append(psnr(blurred, photo))
    pool = np.array(values, float)
    for photos in (6, 10, 20):
        hits = 0
        for _ in range(200):
            drawn = rng.choice(pool, photos, replace=False)
            half = half_width(drawn.tolist())
            assert half is not None
            hits += abs(drawn.mean() - pool.mean()) <= half
        assert 0.85 <= hits / 200 <= 0.95, (photos, hits / 200)
