"""The benchmark `frugality`: rows, ratios, verdict, and what is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks import cli, frugality
from benchmarks.frugality import PROTOCOLS
from benchmarks.rows import Table
from hqgs.training.config import AUTO, ITEMS, NONE, TrainConfig


def call(*arguments: str | Path) -> int:
    return cli.main(["frugality", *(str(a) for a in arguments)])


def test_the_rows() -> None:
    protocol = PROTOCOLS["standard"]
    assert protocol.labels == [NONE, *ITEMS, AUTO]

    def config(label: str, seed: int = 0) -> TrainConfig:
        return protocol.train_config(protocol.rows[protocol.labels.index(label)], seed)

    assert config("none").leave_out == ()
    assert config("iterations").leave_out == ("iterations",)
    assert config("auto", 3).leave_out == ("photos", "passersby", "growth", "weight")
    assert config("auto", 3).seed == 3
    assert all(config(label) == TrainConfig(
        2_000, AUTO, leave_out=config(label).leave_out).scaled() for label in protocol.labels)  # fmt: skip


def test_a_quick_run_is_written_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("--quick", "--out", tmp_path, "--iterations", "8", "--rows", "none", "auto") == 0
    assert "| left out | PSNR (dB) | worst scene |" in capsys.readouterr().out
    runs = Table(tmp_path / "frugality.csv").frame()
    assert list(runs["row"]) == ["none", "auto"]
    assert runs["gaussians"][1] < runs["gaussians"][0]
    assert (runs["bytes"] > 200 * runs["gaussians"] * runs["sh_degree"] / 3).all()  # of the PLY file, which
    assert list(tmp_path.rglob("*.ply")) == []  # was only weighed
    assert (runs["cpu_seconds"] > 0).all()
    assert runs["decision_seconds"][0] == 0 < runs["decision_seconds"][1]

    def never(*_: Any) -> None:
        raise AssertionError("a finished run was repeated")

    monkeypatch.setattr(frugality, "run_cell", never)
    assert call("--quick", "--out", tmp_path, "--iterations", "8", "--rows", "none", "auto") == 0


def test_bad_options_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--rows", "colour", "--out", tmp_path) == 2
    assert "rows: there is no 'colour'; there are: none, photos" in capsys.readouterr().err
    assert call("--seeds", "-1", "--out", tmp_path) == 2
    assert "seed is -1, wanted at least 0" in capsys.readouterr().err
    assert call("--seeds", "0", "0", "--out", tmp_path) == 2
    assert "seeds holds 0 twice" in capsys.readouterr().err
    assert call("--downscale", "0.5", "--out", tmp_path) == 2
    assert "downscale must be at least 1, got 0.5" in capsys.readouterr().err
