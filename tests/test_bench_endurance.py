"""`endurance`: the cases are what they claim, verdicts fail when they should, cases are kept."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_scene import tiny_scene

from benchmarks import cli, endurance
from benchmarks.endurance import CASES, QUICK, Case, EnduranceConfig, run_case, train_config, verdict
from hqgs.training.config import TrainConfig
from hqgs.training.methods.base import ThreeDGS

CONFIG = EnduranceConfig(iterations=20, max_gaussians=80)
LONG = EnduranceConfig()


def call(*arguments: str | Path) -> int:
    return cli.main(["endurance", *(str(a) for a in arguments)])


def case(name: str) -> Case:
    return next(c for c in CASES if c.name == name)


def test_what_the_cases_do_to_the_scene() -> None:
    scene = tiny_scene(num_views=11)
    noisy = case("30 % noise photos").scene(scene)
    changed = [not np.array_equal(a.image, b.image) for a, b in zip(noisy.train, scene.train, strict=True)]
    assert sum(changed) == 3
    spread = np.concatenate([v.image.ravel() for v, c in zip(noisy.train, changed, strict=True) if c])
    assert abs(spread.mean() - 127.5) < 5
    assert abs(spread.std() - 73.9) < 3
    assert noisy.test == scene.test
    assert len(case("one photo").scene(scene).train) == 1
    first, second = case("two identical cameras").scene(scene).train
    assert first.camera == second.camera
    assert np.array_equal(first.image, second.image)
    assert first.name != second.name


def test_what_the_cases_do_to_the_configuration() -> None:
    config = train_config(LONG)
    assert (config.iterations, config.densify.stop, config.densify.reset_every) == (20_000, 10_000, 3_000)
    fast = case("learning rates x10").config(config)
    assert (fast.lr_means, fast.lr_sh0) == pytest.approx((1.6e-3, 2.5e-2))
    assert fast.adam_eps == config.adam_eps
    assert case("opacity resets x10").config(config).densify.reset_every == 300
    assert case("as it is").config(config) == config


@pytest.mark.parametrize("name", [c.name for c in CASES])
def test_every_case_runs(name: str) -> None:
    def roomy(config: TrainConfig) -> TrainConfig:
        """Nothing is pruned as too large: the Gaussians of this scene are."""
        config = chosen.config(config)
        return replace(config, densify=replace(config.densify, prune_scale=100.0))

    chosen = case(name)
    result = run_case(replace(chosen, config=roomy), tiny_scene(), CONFIG)
    assert result["passed"], result["failure"]
    assert [r["iteration"] for r in result["records"]] == list(range(1, 21))
    assert all(r["psnr"] > 0 and r["loss"] > 0 for r in result["records"])
    assert result["slope_mb"] is None  # too short to tell


def test_a_nan_that_is_caught_is_counted_and_fails_the_case(monkeypatch: pytest.MonkeyPatch) -> None:
    real = ThreeDGS.loss
    steps: list[int] = []

    def spoiled(self: ThreeDGS, render: Any, view: Any) -> torch.Tensor:
        steps.append(1)
        return real(self, render, view) * (torch.nan if len(steps) == 7 else 1.0)

    monkeypatch.setattr(ThreeDGS, "loss", spoiled)
    result = run_case(CASES[0], tiny_scene(), CONFIG)
    assert (result["finite"], result["passed"], result["failure"]) == (False, False, None)
    assert [r["losses_not_finite"] for r in result["records"]].count(1) == 1
    assert result["guard"]["num_events"] == 1
    assert len(result["records"]) == 20


def test_a_run_that_breaks_off_is_a_failed_case(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ThreeDGS, "loss", lambda self, render, view: render.sum() * torch.nan)
    result = run_case(CASES[0], tiny_scene(), replace(CONFIG, iterations=40))
    assert "20 steps in a row" in result["failure"]
    assert not result["passed"]
    assert "FAIL" in endurance.table([result], CONFIG)


def made_up(peaks: list[float], gaussians: int = 100, bad: int = 0) -> dict[str, Any]:
    records = [
        {"iteration": 1_000 * (k + 1), "peak_rss_mb": peak, "gaussians": gaussians}
        | {"values_not_finite": bad, "losses_not_finite": 0}
        for k, peak in enumerate(peaks)
    ]
    return {"records": records, "failure": None}


def test_verdicts_of_made_up_runs() -> None:
    growing = [100.0 + 50 * k for k in range(10)]
    flat = verdict(made_up([*growing, *[600.0, 600.5] * 5]), LONG)
    assert flat["passed"]
    assert abs(flat["slope_mb"]) < 0.1
    leak = verdict(made_up([*growing, *(600 + 1.5 * k for k in range(10))]), LONG)
    assert leak["slope_mb"] == pytest.approx(1.5)
    assert (leak["memory_flat"], leak["passed"]) == (False, False)
    assert not verdict(made_up([600.0] * 20, gaussians=30_001), LONG)["passed"]
    assert not verdict(made_up([600.0] * 20, bad=1), LONG)["passed"]


def test_the_command_keeps_finished_cases(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes: list[tuple[int, int]] = []

    def embedded(cache: Path, width: int, height: int) -> Any:
        scenes.append((width, height))
        return tiny_scene()

    monkeypatch.setattr(endurance, "embedded_scene", embedded)
    options = ["--quick", "--out", tmp_path, "--cases", "as it is", "one photo"]
    assert call(*options) == 0
    out, err = capsys.readouterr()
    assert out.count("pass |") == 2
    assert "All passed." in out
    assert err.count("bench endurance:") == 2
    assert scenes == [(42, 32)]
    report = json.loads((tmp_path / "endurance.json").read_text())
    assert [c["case"] for c in report["results"]["cases"]] == ["as it is", "one photo"]
    assert report["settings"]["iterations"] == QUICK.iterations
    assert (tmp_path / "endurance_runs.png").stat().st_size > 10_000
    kept = (tmp_path / "endurance" / "one_photo.json").read_bytes()
    (tmp_path / "endurance" / "as_it_is.json").unlink()
    assert call(*options) == 0
    assert capsys.readouterr().err == "bench endurance: as it is\n"  # the other one is not repeated
    assert (tmp_path / "endurance" / "one_photo.json").read_bytes() == kept
    assert call(*options, "--iterations", "41") == 2
    assert "holds a case with other settings; choose another --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--iterations", "0"], "iterations is 0, wanted at least 1"),
        (["--downscale", "0.5"], "downscale must be in 1..47.25, got 0.5"),
        (["--cases", "none"], "cases: there is no 'none'; there are: as it is, "),
        (["--seed", "-1"], "seed is -1, wanted at least 0"),
    ],
)
def test_bad_options_are_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert call("--quick", "--out", tmp_path, *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"hqgs: {message}")
