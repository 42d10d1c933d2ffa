"""What the screen says of a run without a terminal: how long it takes, early and again and again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from hqgs.base.stages import Stage
from hqgs.cli import progress
from hqgs.cli.progress import LoadingScreen, TrainingScreen


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def told(clock: list[float], step: float, count: int, length: int, every: int = 0) -> list[tuple[int, str]]:
    """The lines of so many steps of `step` seconds each, with their iterations; evaluated `every` so many."""
    screen, lines = TrainingScreen(), list[tuple[int, str]]()
    screen.live = False
    for k in range(1, count + 1):
        clock[0] += step
        done = {"psnr": 20.0, "ssim": 0.5, "views": 2} if every and k % every == 0 else None
        screen.say = lambda text, k=k: lines.append((k, text))
        now: Any = SimpleNamespace(
            iteration=k, length=length, seconds=k * step, gaussians=9, loss=0.1, evaluated=done
        )
        screen(now)
    return lines


def test_fast_steps_are_estimated_after_35(clock: list[float]) -> None:
    ((iteration, text),) = told(clock, 0.05, 100, 1000)
    assert iteration == 36
    assert text.startswith("1,000 iterations, 20.0 per second now: training takes about 48 s to 2 min")


def test_slow_steps_are_estimated_after_a_few(clock: list[float]) -> None:
    iteration, text = told(clock, 2.0, 12, 30_000)[0]
    assert iteration == 9  # five to warm up, and five seconds
    assert "about 16.7 h to 50.0 h" in text


def test_a_line_each_minute_with_what_is_left(clock: list[float]) -> None:
    lines = told(clock, 1.0, 200, 1000)[1:]
    assert [iteration for iteration, _ in lines] == [62, 123, 184]
    assert lines[0][1] == "iteration 62 of 1000: 9 Gaussians, 62 s, loss 0.100; about 16 min left"


def test_evaluations_say_on_how_many_views_and_what_is_left(clock: list[float]) -> None:
    lines = told(clock, 1.0, 100, 100, every=50)[1:]
    assert lines == [
        (
            50,
            "iteration 50: 9 Gaussians, 50 s, 2 of the held-out views 20.00 dB, SSIM 0.5000; about 50 s left",
        ),
        (100, "iteration 100: 9 Gaussians, 100 s, 2 of the held-out views 20.00 dB, SSIM 0.5000"),
    ]


def test_before_the_first_step_no_silence_lasts(clock: list[float]) -> None:
    """A line every few seconds while something is done, of whatever it is; none where it is quick."""
    lines = list[tuple[float, str]]()
    screen = LoadingScreen()
    screen.live = False
    say = screen.say
    screen.say = lambda text: (lines.append((clock[0] - 100, text)), say(text))[0]
    screen.stage(Stage("COLMAP", 0, 9, "It takes long."))
    for what, step in (("photos read", 0.1), ("COLMAP: features", 2.0), ("COLMAP: matches", 0.1)):
        for k in range(1, 10):
            clock[0] += step
            screen.stage(Stage(what, k, 9))
    clock[0] += 10
    screen.stage(Stage("frames", 4, 0))
    told = [(round(when), text) for when, text in lines]
    assert told == [
        (0, "It takes long."),
        (7, "COLMAP: features: 3 of 9"),
        (13, "COLMAP: features: 6 of 9"),
        (19, "COLMAP: features: 9 of 9"),
        (30, "frames: 4"),
    ]
    assert screen.colmap_seconds == pytest.approx(18.9)
