"""The benchmark `frugality`: rows, ratios, verdict, and what is kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pandas import DataFrame

from benchmarks import cli, frugality
from benchmarks.frugality import PROTOCOLS, against_none, verdict
from benchmarks.study import Store
from hqgs.training.config import AUTO, ITEMS, NONE, TrainConfig


def call(*arguments: str | Path) -> int:
    return cli.main(["frugality", *(str(a) for a in arguments)])


def run_of(scene: str, row: str, **changes: Any) -> dict[str, Any]:
    values = {"psnr": 30.0, "ssim": 0.9, "cpu_seconds": 100.0, "seconds": 100.0, "decision_seconds": 0.0}
    return {"scene": scene, "row": row, "seed": 0, "gaussians": 1000, "bytes": 3000} | values | changes


def test_the_rows() -> None:
    protocol = PROTOCOLS["standard"]
    assert protocol.labels == [NONE, *ITEMS, AUTO]

    def config(label: str, seed: int = 0) -> TrainConfig:
        return protocol.train_config(protocol.rows[protocol.labels.index(label)], seed)

    assert config("none").leave_out == ()
    assert config("iterations").leave_out == ("iterations",)
    assert config("auto", 3).leave_out == ("photos", "growth", "weight")
    assert config("auto", 3).seed == 3
    assert all(config(label) == TrainConfig(
        7_000, "3dgs", leave_out=config(label).leave_out).scaled() for label in protocol.labels)  # fmt: skip


def test_means_and_the_worst_scene_against_none() -> None:
    runs = [
        run_of("a", "none"),
        run_of("a", "auto", psnr=30.1, cpu_seconds=40.0, bytes=600, seconds=40.0, decision_seconds=0.4),
        run_of("b", "none", psnr=25.0),
        run_of("b", "auto", psnr=24.9, cpu_seconds=60.0, bytes=1200, seconds=60.0, decision_seconds=0.6),
        run_of("c", "auto"),  # has nothing to be compared with
    ]
    found = against_none(DataFrame(runs))["auto"]
    assert found["scenes"] == 2
    assert found["psnr"] == pytest.approx(0.0)
    assert found["worst_psnr"] == pytest.approx(-0.1)
    assert found["cpu_seconds"] == pytest.approx(0.5)
    assert found["bytes"] == pytest.approx(0.3)
    assert found["decision_share"] == pytest.approx(0.01)
    assert all(verdict(found).values())
    assert list(against_none(DataFrame(runs))) == ["auto"]
    for name, key, value in (
        ("time", "cpu_seconds", 0.51),
        ("bytes", "bytes", 0.34),
        ("mean PSNR", "psnr", -0.06),
        ("worst PSNR", "worst_psnr", -0.16),
        ("decisions", "decision_share", 0.021),
    ):
        missed = [target for target, reached in verdict(found | {key: value}).items() if not reached]
        assert missed == [name]


def test_the_worst_scene_is_the_mean_of_its_seeds() -> None:
    runs = [run_of("a", "none", seed=seed) for seed in (0, 1)]
    runs += [run_of("a", "auto", seed=0, psnr=29.6), run_of("a", "auto", seed=1, psnr=30.2)]
    runs += [run_of("b", "none"), run_of("b", "auto", psnr=30.3)]
    found = against_none(DataFrame(runs))["auto"]
    assert (found["scenes"], found["runs"]) == (2, 3)
    assert found["worst_psnr"] == pytest.approx(-0.1)
    assert found["psnr"] == pytest.approx(0.1)


def test_a_quick_run_is_written_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("--quick", "--out", tmp_path, "--iterations", "8", "--rows", "none", "auto") == 0
    printed = capsys.readouterr().out
    assert "Against none" in printed
    written = json.loads((tmp_path / "frugality.json").read_text(encoding="utf-8"))
    runs = written["results"]["runs"]
    assert [run["row"] for run in runs] == ["none", "auto"]
    assert runs[1]["gaussians"] < runs[0]["gaussians"]
    assert runs[1]["left_out"]
    assert (tmp_path / "frugality_gains.png").stat().st_size > 10_000
    here = Store(tmp_path).here
    assert sorted(path.suffix for path in here.iterdir()) == [
        ".json",
        ".json",
    ]  # the PLY file was only weighed
    assert all(run["bytes"] > 200 * run["gaussians"] * run["sh_degree"] / 3 for run in runs)

    def never(*_: Any) -> None:
        raise AssertionError("a finished run was repeated")

    monkeypatch.setattr(frugality, "run_cell", never)
    assert call("--quick", "--out", tmp_path, "--iterations", "8", "--rows", "none", "auto") == 0

    next(here.glob("*-none-*")).write_text("[", encoding="utf-8")
    assert call("--quick", "--out", tmp_path, "--iterations", "8", "--rows", "none", "auto") == 2
    assert "is damaged" in capsys.readouterr().err


def test_bad_options_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--rows", "colour", "--out", tmp_path) == 2
    assert "rows: there is no 'colour'; there are: none, photos" in capsys.readouterr().err
    assert call("--seeds", "-1", "--out", tmp_path) == 2
    assert "seed is -1, wanted at least 0" in capsys.readouterr().err
    assert call("--seeds", "0", "0", "--out", tmp_path) == 2
    assert "seeds holds 0 twice" in capsys.readouterr().err
    assert call("--downscale", "0.5", "--out", tmp_path) == 2
    assert "downscale must be at least 1, got 0.5" in capsys.readouterr().err
