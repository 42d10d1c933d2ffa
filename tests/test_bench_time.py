"""The benchmark `time`: runs that have seconds, and one that keeps its course."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.rows import Table, pairs_of


def test_a_quick_run_has_a_line_for_each_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["time", "--quick", "--out", str(tmp_path), "--threads", "1"]) == 0
    assert "| embedded | 0.5 s | 0 |" in capsys.readouterr().out
    base, timed = Table(tmp_path / "time.csv").frame().to_dict("records")
    course = pairs_of(base["history"])
    assert [base["row"], base["trained"], len(course)] == ["3dgs", 60, 1]
    assert float(course[-1][0]) == pytest.approx(base["seconds"], rel=1e-4)
    assert course[-1][1] == pytest.approx(base["psnr"], abs=0.01)
    assert (timed["row"], timed["iterations"], timed["history"]) == ("0.5 s", 60, "")
    assert timed["trained"] > 0
    assert 0 < timed["haarpsi"] < 1
