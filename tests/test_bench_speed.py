"""`speed` at tiny sizes: the fields of its JSON, numbers that agree with each other and with those of another
computation, and what it says when something is missing."""

from __future__ import annotations

import argparse
import json
import math
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from replay import blended_counts, random_pixels

import hqgs
from benchmarks import cli
from benchmarks.output import command_line
from benchmarks.speed.inputs import make_inputs
from benchmarks.speed.rasterizer import RasterPass, count_work
from benchmarks.speed.timing import StageClock, exponent, interleaved, median_ratio
from benchmarks.speed.training import make_trainer
from hqgs import _rust
from hqgs.base.text import markdown_table

CRATE = ["project", "bin and composite", "composite backward", "project backward"]


def call(*arguments: str | Path) -> int:
    return cli.main(["speed", *map(str, arguments)])


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("bench")
    before = hqgs.get_num_threads()
    hqgs.set_num_threads(2)
    try:
        assert call("--quick", "--out", out, "--seed", "5") == 0
        assert hqgs.get_num_threads() == 2
    finally:
        hqgs.set_num_threads(before)
    result = json.loads((out / "speed.json").read_text(encoding="utf-8"))
    assert {p.name for p in out.iterdir()} == {"speed.json", "speed_scaling.png"}
    with Image.open(out / "speed_scaling.png") as chart:
        assert chart.size == (1350, 600)
        assert len(np.unique(np.asarray(chart.convert("RGB")).reshape(-1, 3), axis=0)) > 10
    return result


def test_the_file_says_where_it_comes_from(quick: dict[str, Any]) -> None:
    assert quick["benchmark"] == "speed"
    assert quick["command"].startswith("python -m benchmarks speed --method 3dgs --parts rasterizer step")
    assert quick["command"].endswith("--quick --seed 5")
    assert datetime.fromisoformat(quick["date"]).utcoffset() is not None
    assert quick["commit"] == quick["versions"]["git_commit"]
    assert quick["machine"]["cores"] >= 1
    assert quick["threads"] == 2
    assert quick["settings"]["seed"] == quick["settings"]["memory"]["seed"] == 5


def test_stages_make_up_the_whole(quick: dict[str, Any]) -> None:
    step = [*CRATE, "loss", "Adam", "autograd"]
    for part, stages in (("rasterizer", CRATE), ("step", step), ("formations", step)):
        for row in quick["results"][part]:
            assert len(row["rounds"]) == quick["settings"]["repeats"]
            for seconds in row["rounds"]:
                stated = sum(v for k, v in seconds.items() if k not in ("total", "bin"))
                assert stated == pytest.approx(seconds["total"])
                assert 0 <= seconds.get("bin", 0) <= seconds["bin and composite"]  # a part of that stage
                assert min(seconds.values()) >= 0
            assert min(row["stages"][stage] for stage in stages) > 0
            low, high = row["seconds_quartiles"]
            assert 0 < low <= row["seconds"] <= high
    for row in quick["results"]["step"]:
        assert sum(row["percent"].values()) == pytest.approx(100)


def test_steps_of_hqgs_stand_beside_those_of_3dgs(quick: dict[str, Any]) -> None:
    rows = quick["results"]["formations"]
    assert [r["case"] for r in rows] == [
        "3dgs, 500", "hqgs, blur", "hqgs, lowres:2", "hqgs, jpeg:10", "hqgs, blur+lowres:2+jpeg:10",
        "hqgs, paper's V6", "hqgs, paper's V7",
    ]  # fmt: skip
    assert [r["method"] for r in rows] == ["3dgs"] + 6 * ["hqgs"]
    assert rows[0]["over_first"] == 1
    assert all(0.5 < r["over_first"] / (r["seconds"] / rows[0]["seconds"]) < 2 for r in rows)
    assert {r["gaussians"] for r in rows} == {500}
    assert rows[0]["stages"]["method"] < rows[1]["stages"]["method"]  # no Gaussian is too small


def test_work_and_limit_follow_from_the_counts(quick: dict[str, Any]) -> None:
    for row in quick["results"]["rasterizer"]:
        work = row["work"]
        assert 30 < work["blended_per_pixel"] < 42
        assert work["blended_pairs"] == pytest.approx(work["blended_per_pixel"] * 96 * 72)
        inputs = make_inputs(row["gaussians"], 96, 72, seed=5)
        everywhere = np.stack(np.meshgrid(np.arange(96), np.arange(72)), axis=-1).reshape(-1, 2)
        assert work["blended_pairs"] == pytest.approx(blended_counts(inputs, everywhere).sum(), rel=1e-4)
        assert row["limit_seconds"] == pytest.approx(work["blended_pairs"] * 1.7e-9 / 2)
        assert row["times_limit"] == pytest.approx(row["seconds"] / row["limit_seconds"])
        assert 0 < work["changed_blocks"] <= work["blocks"] <= 16 * work["tile_pairs"]
        assert work["blended_pairs"] <= 16 * work["changed_blocks"]
        assert work["lane_use"] == pytest.approx(work["blended_pairs"] / (16 * work["blocks"]))


def test_speed_up_growth_and_memory(quick: dict[str, Any]) -> None:
    results = quick["results"]
    assert [r["threads"] for r in results["threads"]] == [1, 2, 1, 2]
    assert [r["speedup"] for r in results["threads"] if r["threads"] == 1] == [1, 1]
    assert all(0 < r["speedup"] < 20 for r in results["threads"])
    for name in ("gaussians", "pixels"):
        curve = results["scaling"][name]
        assert curve["x"] == sorted(curve["x"])
        assert math.isfinite(curve["exponent"])
        assert curve["exponent"] <= curve["steepest"] + 1e-9
    memory = results["memory"]
    assert 50 < memory["imports_mb"] <= memory["scene_mb"] <= memory["peak_mb"]


def test_parts_can_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--quick", "--parts", "rasterizer", "--repeats", "1", "--out", tmp_path) == 0
    result = json.loads((tmp_path / "speed.json").read_text(encoding="utf-8"))
    assert list(result["results"]) == ["rasterizer"]
    assert len(result["results"]["rasterizer"][0]["rounds"]) == 1
    printed = capsys.readouterr().out
    assert "| Gaussians | project | bin and composite |" in printed
    assert printed.splitlines()[-1] == f"written: {tmp_path / 'speed.json'}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "repeats is 0, wanted at least 1"),
        (["--method", "4dgs"], "unknown method '4dgs'"),
        (["--threads", "0"], "threads"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert call("--quick", "--out", tmp_path, *arguments) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "speed.json").exists()


@pytest.mark.parametrize(("n", "width", "height"), [(300, 80, 60), (2_000, 80, 60), (4_000, 252, 189)])
def test_blended_gaussians_are_those_with_a_colour_gradient(
    n: int, width: int, height: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = make_inputs(n, width, height, seed=3)
    pixels = random_pixels(inputs, 12, seed=1)
    means, quats, scales, opacities = (
        torch.from_numpy(getattr(inputs, name)).double() for name in ("means", "quats", "scales", "opacities")
    )
    colors = torch.rand(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    colors.requires_grad_()
    view = torch.from_numpy(inputs.viewmat)[None], torch.from_numpy(inputs.K)[None]
    states = []
    composite = _rust.composite_forward

    def keeping_the_state(*args: Any) -> Any:
        states.append(composite(*args))
        return states[-1]

    monkeypatch.setattr(_rust, "composite_forward", keeping_the_state)
    image, _, _ = hqgs.rasterization(means, quats, scales, opacities, colors, *view, width, height)
    expected = []
    for column, row in pixels:
        (grad,) = torch.autograd.grad(image[0, row, column].sum(), colors, retain_graph=True)
        expected.append(int((grad[:, 0] != 0).sum()))
    assert blended_counts(inputs, pixels).tolist() == expected
    everywhere = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    if width * height < 10_000:
        assert blended_counts(inputs, everywhere).sum() == states[0][0].blended  # the crate's own counter


@pytest.mark.parametrize(("n", "width", "height"), [(3_000, 252, 189), (30_000, 252, 189), (3_000, 504, 378)])
def test_the_overlap_does_not_depend_on_the_sizes(n: int, width: int, height: int) -> None:
    inputs = make_inputs(n, width, height)
    assert len(inputs) == n
    assert (inputs.width, inputs.height) == (width, height)
    assert 36 < blended_counts(inputs, random_pixels(inputs, 300, seed=0)).mean() < 41


def test_inputs_follow_from_the_seed() -> None:
    first, again, other = make_inputs(50, 80, 60, 1), make_inputs(50, 80, 60, 1), make_inputs(50, 80, 60, 2)
    for name in vars(first):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    assert not np.array_equal(first.means, other.means)


def test_too_many_gaussians_for_the_image_are_refused() -> None:
    with pytest.raises(ValueError, match=r"90000 Gaussians are too many for 80 x 60 pixels"):
        make_inputs(90_000, 80, 60)


def test_a_stage_does_not_count_the_stages_within_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    class Owner:
        inner: Any
        outer: Any

    owner = Owner()

    def passing(seconds: float) -> None:
        now[0] += seconds

    def outer() -> None:
        passing(1.0)
        owner.inner(2.0)
        passing(4.0)
        owner.inner(8.0)

    owner.inner, owner.outer = passing, outer

    def work() -> None:
        owner.outer()
        passing(16.0)

    clock = StageClock()
    with clock.watching({(owner, "outer"): "a", (owner, "inner"): "b"}):
        seconds = clock.seconds(work, ["a", "b", "c"])
    assert seconds == {"total": 31.0, "a": 5.0, "b": 10.0, "c": 0.0, "rest": 16.0}
    assert (owner.inner, owner.outer) == (passing, outer)


def test_cases_take_turns() -> None:
    calls: list[str] = []

    def case(name: str, factor: float) -> Any:
        def run() -> dict[str, float]:
            calls.append(name)
            return {"total": factor * len(calls)}

        return run

    measured = interleaved({"a": case("a", 1.0), "b": case("b", 10.0)}, 3)
    assert "".join(calls) == "ab" + "abbaab"
    assert list(measured["a"]["total"]) == [3, 6, 7]
    assert list(measured["b"]["total"]) == [40, 50, 80]
    assert median_ratio(measured["b"], measured["a"]) == pytest.approx(80 / 7)


def test_exponent_of_a_power_law() -> None:
    assert exponent([1, 10, 100], [2, 2 * 10**1.3, 2 * 100**1.3]) == pytest.approx(1.3)


def test_work_of_a_hand_made_case() -> None:
    # 80 Gaussians blend in two pixels: 40 each. 10 pairs with tiles, 8 blocks of 16 lanes.
    case = RasterPass(make_inputs(20, 30, 20))
    case.blended, case.work = 80, (10, 8, 6)
    work = count_work(case, 2)
    assert work["blended_pairs"] == 80
    assert work["blended_per_pixel"] == 40
    assert work["lane_use"] == 80 / 128
    assert work["changed_share"] == 6 / 8
    assert work["limit_core_seconds"] == pytest.approx(136e-9)


def test_the_scene_stays_what_it_is_while_it_is_timed() -> None:
    trainer = make_trainer(400, 64, 48, 2, "3dgs", seed=1)
    before = {name: tensor.detach().clone() for name, tensor in trainer.gaussians.named().items()}
    for _ in range(8):
        trainer.step()
    for name, tensor in trainer.gaussians.named().items():
        assert torch.allclose(tensor, before[name], atol=1e-4), name
        assert not torch.equal(tensor, before[name]), name  # Adam did update it
    grad = trainer.gaussians.shN.grad
    assert grad is not None
    assert (grad[:, -7:] != 0).any()  # degree 3 is trained
    assert trainer.state.densifier.count.max() == 8


def test_command_line_holds_no_paths() -> None:
    args = argparse.Namespace(
        benchmark="speed", out=Path("/x"), folder=Path("/home/me/raster"), quick=True, seed=3, threads=None,
        parts=["step"], run=print, command="bench",
    )  # fmt: skip
    assert command_line(args) == "python -m benchmarks speed --folder raster --parts step --quick --seed 3"


def test_markdown_table() -> None:
    assert markdown_table("T", ["a", "bb"], [["x", "1"], ["yyy", "22"]]).splitlines() == [
        "**T**", "", "| a   | bb |", "| --- | -: |", "| x   |  1 |", "| yyy | 22 |",
    ]  # fmt: skip
