"""`endurance`: the cases are what they claim, verdicts fail when they should, cases are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_scene import tiny_scene

from benchmarks import cli, protocol
from benchmarks.endurance import PROTOCOLS, run_case, verdict
from benchmarks.protocol import Row
from benchmarks.rows import Table
from hqgs.training.methods.base import ThreeDGS

CASES = PROTOCOLS["standard"].rows
LONG = PROTOCOLS["standard"].train_config(CASES[0], 0)
SHORT = {"densify": {"max_gaussians": 80, "stop": 10}}


def call(*arguments: str | Path) -> int:
    return cli.main(["endurance", *(str(a) for a in arguments)])


def case(name: str) -> Row:
    return next(c for c in CASES if c.label == name)


def test_what_the_cases_do_to_the_configuration() -> None:
    config = LONG
    assert config.densify.max_gaussians == 30_000
    assert (config.iterations, config.due.stop, config.densify.reset_every) == (20_000, 10_000, 3_000)
    fast = PROTOCOLS["standard"].train_config(case("learning rates x10"), 0)
    rates = {name: 10 * rate for name, rate in vars(config).items() if name.startswith("lr_")}
    assert {name: vars(fast)[name] for name in rates} == pytest.approx(rates, rel=1e-12)
    assert replace(fast, **{name: vars(config)[name] for name in rates}) == config
    assert [c.label for c in CASES] == ["as it is", "learning rates x10"]


@pytest.mark.parametrize("name", [c.label for c in CASES])
def test_every_case_runs(name: str) -> None:
    config = case(name).train_config(0, 20, SHORT)
    # Nothing is pruned as too large: the Gaussians of this scene are.
    config = replace(config, densify=replace(config.densify, prune_scale=100.0))
    result, records = run_case(tiny_scene(), config)
    assert result["passed"], result["failure"]
    assert [r["iteration"] for r in records] == list(range(1, 21))
    assert all(r["psnr"] > 0 and r["loss"] > 0 for r in records)
    assert result["psnr"] == records[-1]["psnr"]
    assert result["most_gaussians"] == max(r["gaussians"] for r in records)
    assert result["slope_mb"] is None  # too short to tell


def test_a_nan_that_is_caught_is_counted_and_fails_the_case(monkeypatch: pytest.MonkeyPatch) -> None:
    real = ThreeDGS.loss
    steps: list[int] = []

    def spoiled(self: ThreeDGS, render: Any, view: Any) -> torch.Tensor:
        steps.append(1)
        return real(self, render, view) * (torch.nan if len(steps) == 7 else 1.0)

    monkeypatch.setattr(ThreeDGS, "loss", spoiled)
    config = CASES[0].train_config(0, 20, SHORT)
    result, records = run_case(tiny_scene(), config)
    assert (result["finite"], result["passed"], result["failure"]) == (False, False, None)
    assert [r["losses_not_finite"] for r in records].count(1) == 1
    assert result["events"] == 1
    assert len(records) == 20


def test_a_run_that_breaks_off_is_a_failed_case(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ThreeDGS, "loss", lambda self, render, view: render.sum() * torch.nan)
    result, _ = run_case(tiny_scene(), CASES[0].train_config(0, 40, SHORT))
    assert "20 steps in a row" in result["failure"]
    assert not result["passed"]


def made_up(peaks: list[float], gaussians: int = 100, bad: int = 0) -> dict[str, Any]:
    records = [
        {"iteration": 1_000 * (k + 1), "peak_mb": peak, "gaussians": gaussians}
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
    sizes: list[tuple[int, int]] = []

    def embedded(cache: Path, width: int, height: int, **options: Any) -> Any:
        sizes.append((width, height))
        return tiny_scene()

    monkeypatch.setattr(protocol, "embedded_scene", embedded)
    options = ["--quick", "--out", tmp_path, "--rows", "as it is", "learning rates x10"]
    assert call(*options) == 0
    out, err = capsys.readouterr()
    assert out.count("pass |") == 2
    assert "All passed." in out
    assert "endurance: 2 runs, 2 left" in err
    assert "[1/2] embedded, as it is, seed 0: " in err
    assert "[2/2] embedded, learning rates x10, seed 0: " in err
    assert sizes == [(42, 32)]
    table = Table(tmp_path / "endurance.csv")
    plain, one = table.rows()
    assert [plain["row"], one["row"]] == ["as it is", "learning rates x10"]
    assert plain["psnr"] != one["psnr"]
    whole = table.path.read_text(encoding="utf-8").splitlines(keepends=True)
    table.path.write_text("".join(line for line in whole if "as it is" not in line), encoding="utf-8")
    assert call(*options, "--finished") == 0
    assert "NOT all passed." in capsys.readouterr().out  # one is missing
    assert call(*options) == 0
    err = capsys.readouterr().err
    assert "2 runs, 1 left" in err
    assert "learning rates x10" not in err  # the other one is not repeated
    assert table.rows()[0] == one
    assert call(*options, "--iterations", "41") == 0  # other settings are other runs
    assert "2 runs, 2 left" in capsys.readouterr().err
    assert table.rows()[0] == one
