"""Pages of results and their intervals: numbers are those of the tables, no gain lies within its scatter."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from docs_claims import ROOT, wrong_command
from pandas import DataFrame
from scipy import stats
from scipy.ndimage import gaussian_filter

from benchmarks import cli
from benchmarks.pages.figures import beside, crossed, gain, gains, made, mean, number, pick, weakest
from benchmarks.pages.sections import (
    beside_base,
    cost_of_poses,
    costs_in_words,
    levels,
    seeds_apart,
)  # fmt: skip
from benchmarks.pages.write import RESULTS, STUDIES, pages
from benchmarks.rows import KEYS, RUN, Table, pairs_of, text_of
from benchmarks.scenes.room.shading import render_view
from benchmarks.scenes.sparse import ARC, HIGH, LOW, camera_on_arc
from hqgs.evaluation.constants import CONFIDENCE
from hqgs.evaluation.intervals import SPREAD_LOGS, SPREADS, difference, half_width, with_half
from hqgs.evaluation.metrics import psnr

DOCS = ROOT / "docs"
PAGES = pages(DOCS / RESULTS)
STUDENT = 6.3138  # the 95 % quantile of two runs
MOST_WORDS, MOST_OF_ALL, MOST_OF_THE_LOG, MOST_BYTES = 1_500, 7_000, 2_000, 300_000


def run_of(row: str, psnr: float, **changes: object) -> dict[str, object]:
    facts = {"scene": "a", "degradation": "blur", "seed": 0, "iterations": 10, "downscale": 2, "poses": "own"}
    made_by = {"commit": "abc", "machine": "CPU", "date": "2026-11-26"}
    return facts | {"row": row, "psnr": psnr} | made_by | changes


def frame(*runs: dict[str, object]) -> DataFrame:
    return DataFrame(list(runs))


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_a_page_is_what_its_tables_give(page: Path) -> None:
    """Else: `python -m benchmarks pages`."""
    assert (DOCS / page).read_text(encoding="utf-8") == PAGES[page]


def test_there_is_no_other_page_and_no_other_table() -> None:
    names = {path.name for path in (DOCS / RESULTS).iterdir() if not path.name.startswith(".")}
    assert names == {page.name for page in PAGES if page.parent == RESULTS} | {f"{name}.csv" for name in KEYS}


def test_pages_and_tables_stay_small() -> None:
    words = {page: len(text.split()) for page, text in PAGES.items()}
    assert max(words.values()) <= MOST_WORDS
    assert sum(words.values()) <= MOST_OF_ALL
    assert len((DOCS / "log.md").read_text(encoding="utf-8").split()) <= MOST_OF_THE_LOG
    assert sum(path.stat().st_size for path in DOCS.rglob("*") if path.suffix != ".png") <= MOST_BYTES


@pytest.mark.parametrize("study", STUDIES)
def test_the_command_of_a_study_can_be_given(study: str) -> None:
    assert wrong_command(["python", "-m", "benchmarks", *shlex.split(STUDIES[study])]) == []


def test_a_table_keeps_one_line_a_key(tmp_path: Path) -> None:
    table = Table(tmp_path / "quality.csv")
    assert table.rows() == []
    assert list(table.frame().columns) == list(RUN)
    table.put([run_of("3dgs", 20.123456789), run_of("hqgs", 21.0, found="blur:1,2")])
    table.put([run_of("3dgs", 22.0, commit="6230379", seconds=None)])
    found = table.frame()
    assert list(found["row"]) == ["3dgs", "hqgs"]  # in its place
    assert list(found["psnr"]) == [22.0, 21.0]
    assert list(found["commit"]) == ["6230379", "abc"]  # no number
    assert found["seconds"].isna().all()
    assert table.find(run_of("hqgs", 0.0))["found"] == "blur:1,2"  # type: ignore[index]
    assert table.find(run_of("hqgs", 0.0, seed=1)) is None
    assert pairs_of(text_of({"a:b": 1.0, "c": 0.25})) == [("a:b", 1.0), ("c", 0.25)]
    table.path.write_text("scene,row\na,b\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"quality.csv is damaged: it has no column degradation"):
        table.rows()
    table.path.write_text(f"{','.join(RUN)}\na,b\n", encoding="utf-8")
    with pytest.raises(ValueError, match="too many or too few cells"):
        table.rows()


def test_gains_are_those_of_pairs() -> None:
    runs = frame(
        run_of("3dgs", 20.0), run_of("hqgs", 21.0),
        run_of("3dgs", 30.0, scene="b"), run_of("hqgs", 32.0, scene="b"),
        run_of("hqgs", 99.0, scene="c"), run_of("3dgs", 0.0, seed=1),
    )  # fmt: skip
    found = gain(runs, "hqgs", "3dgs")
    assert (found.count, found.mean, found.worst) == (2, 1.5, 1.0)
    assert found.error == pytest.approx(0.5 * STUDENT, abs=1e-4)  # std 0.707 over the root of 2
    assert found.text() == "+1.50 ± 3.16"


@pytest.mark.parametrize(
    ("differences", "words"),
    [
        ([1.0, 1.2], "gains 1.10 ± 0.63 dB over `3dgs`"),
        ([-1.0, -1.2], "loses 1.10 ± 0.63 dB to `3dgs`"),
        ([1.0, -0.4], "does not differ from `3dgs` beyond scatter (+0.30 ± 4.42 dB)"),
        ([1.0], "is 1.00 dB above `3dgs` in one run"),
        ([], "was not measured"),
    ],
)
def test_a_difference_within_its_scatter_is_no_gain(differences: list[float], words: str) -> None:
    runs = [run_of("3dgs", 20.0, seed=k) for k in range(3)]
    runs += [run_of("hqgs", 20.0 + gained, seed=k) for k, gained in enumerate(differences)]
    assert gain(frame(*runs), "hqgs", "3dgs").words() == words


def test_tables_by_hand() -> None:
    runs = frame(
        run_of("3dgs", 30.0, degradation="none"), run_of("hqgs", 30.5, degradation="none"),
        run_of("3dgs", 20.0, gaussians=10), run_of("hqgs", 22.0, gaussians=20),
        run_of("3dgs", 24.0, degradation="jpeg:5", gaussians=30), run_of("hqgs", 25.0, degradation="jpeg:5"),
    )  # fmt: skip
    bad = runs.iloc[2:]
    assert crossed(bad, also={"psnr": ("mean", ".1f"), "gaussians": ("N", ".0f")}).splitlines() == [
        "|  | blur | jpeg:5 | mean | N |", "|---|--:|--:|--:|--:|",
        "| 3dgs | 20.00 | 24.00 | 22.0 | 20 |",
        "| hqgs | 22.00 | 25.00 | 23.5 | – |",  # never over fewer runs
    ]  # fmt: skip
    assert gains(runs, ["hqgs"], "3dgs").splitlines()[-1] == (
        "| hqgs | +0.50 | +2.00 | +1.00 | +1.17 ± 1.29 |"
    )
    assert beside(runs, scenes=["a"]).splitlines()[3] == "| blur | 20.00 | 22.00 | +2.00 | +2.00 | +2.00 |"
    assert beside(runs, words={"blur": "soft"}).splitlines()[2:] == [
        "| soft | 20.00 | 22.00 | +2.00 | +2.00 |"
    ]
    assert weakest(runs) == "none (+0.50 dB), most under blur (+2.00 dB)"
    assert list(pick(runs, degradation=["jpeg:5", "none"])["degradation"]) == 2 * ["jpeg:5"] + 2 * ["none"]
    assert mean(runs.iloc[:0]) == "–"
    assert [number(0.0314, "ms"), number(True, "yes|no"), number(float("nan"), ".2f")] == ["31.4", "yes", "–"]


def test_where_runs_are_from_is_said_once() -> None:
    one = frame(run_of("3dgs", 20.0))
    assert made(one) == "1 lines; commit abc; CPU; 2026-11-26."
    two = made(one, frame(run_of("hqgs", 20.0, commit="def", date="2026-11-25")))
    assert two.startswith("2 lines; commits def, abc; CPU; 2026-11-25 to 2026-11-26. Not of one code")
    same = made(one.assign(sources="1"), one.assign(sources="1", commit="def"))
    assert same == "2 lines; commits abc, def; CPU; 2026-11-26."  # whose sources are the same
    assert made(one.iloc[:0]) == "Not measured yet."


def test_seconds_by_hand() -> None:
    times = frame(
        run_of("3dgs", 28.0, seconds=100.0, setup_seconds=2, history="9:20|31:25|90:28"),
        run_of("30 s", 26.0, seconds=29.0, setup_seconds=2, history=""),
        run_of("60 s", 27.95, seconds=61.0, setup_seconds=2, history=""),
    )  # fmt: skip
    beside = beside_base(times)
    assert list(beside["row"]) == ["30 s", "60 s"]
    assert list(beside["base"]) == [20.0, 25.0]
    assert list(beside["lead"]) == pytest.approx([6.0, 2.95])
    late = times.assign(history=["50:20", "", ""])
    assert list(beside_base(late)["lead"].isna()) == [True, False]  # before its first evaluation
    assert levels(times, ["a"]).splitlines()[-1] == "| a | 27.90 | 63 | 92 |"
    assert levels(times.iloc[:2], ["a"]).splitlines()[-1] == "| a | 27.90 | – | 92 |"


def test_what_poses_cost_and_seeds_differ_by() -> None:
    posed = frame(run_of("hqgs", 30.0), run_of("hqgs", 29.0, poses="photos"), run_of("hqgs", 9.0, seed=1))
    posed = posed.assign(psnr_fitted=posed["psnr"] + [0.5, 1.0, 0.0])
    assert cost_of_poses(posed).splitlines()[::2] == ["|  | a |", "| blur | 30.00: -1.00/-0.50 |"]
    assert costs_in_words(posed) == "-1.00 dB (at worst -1.00), fitted -0.50 dB (at worst -0.50)"
    seeds = [run_of("3dgs", 20.0 + k / 4, seed=k, degradation="none") for k in range(3)]
    assert seeds_apart(frame(*seeds)) == 0.5


def test_pages_are_written_whole(tmp_path: Path) -> None:
    """Into another folder."""
    assert cli.main(["pages", "--docs", str(tmp_path)]) == 0
    assert {
        path.relative_to(tmp_path): path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.md")
    } == PAGES


# --- Intervals of means over photos, and of differences of two scenes


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
    assert apart["sure"]
    assert apart["mean"] == pytest.approx(0.1, abs=0.03)
    alone = half_width(hard.tolist())
    assert alone is not None
    assert alone > 1
    noisy = difference((hard + rng.normal(0, 1, 8)).tolist(), other.tolist())
    assert noisy is not None
    assert not noisy["sure"]
    single = difference([25.0], [24.0])
    assert single is not None
    assert not single["sure"]


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
