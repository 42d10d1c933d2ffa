"""`all`: every study behind the pages is run once, and its lines take the place of those of the pages."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from benchmarks import cli, everything
from benchmarks.everything import command_of, publish
from benchmarks.pages.write import STUDIES
from benchmarks.rows import RUN, Table


def line(row: str, psnr: float, **changes: object) -> dict[str, object]:
    values = ("a", "none", row, 0, 10, 1.0, "own")
    return dict(zip(RUN, values, strict=True)) | {"psnr": psnr, "history": ""} | changes


def test_a_word_in_capitals_is_a_capture(tmp_path: Path) -> None:
    (tmp_path / "fern").mkdir()
    assert command_of("quality --scenes FERN embedded --seeds 0", tmp_path) == [
        "quality", "--scenes", str(tmp_path / "fern"), "embedded", "--seeds", "0",
    ]  # fmt: skip
    with pytest.raises(FileNotFoundError, match=r"there is no capture .*fox"):
        command_of("quality --scenes FOX", tmp_path)
    with pytest.raises(ValueError, match="captures: wanted the folder that has fox"):
        command_of("quality --scenes FOX", None)


def test_each_benchmark_has_a_study() -> None:
    assert {shlex.split(options)[0] for options in STUDIES.values()} == set(cli.BENCHMARKS)


def test_what_is_done_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    called: list[str] = []
    codes = {"speed": 1}

    def call(words: list[str]) -> int:
        called.append(words[0])
        assert words[1:] == ["--quick", "--out", str(tmp_path)]
        return codes.get(words[0], 0)

    monkeypatch.setattr(everything, "call", call)
    options = ["all", "--quick", "--out", str(tmp_path)]
    assert cli.main(options) == 0
    assert sorted(called) == sorted(cli.BENCHMARKS)
    assert "speed: exit code 1" in capsys.readouterr().out
    called.clear()
    codes.clear()
    assert cli.main(options) == 0
    assert called == ["speed"]  # is tried again
    monkeypatch.setattr(everything, "sources", lambda: "other")
    called.clear()
    codes["accuracy"] = 130
    assert cli.main(options) == 130  # Ctrl-C ends all of it
    assert called[-1] == "accuracy"


def test_studies_can_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["all", "--only", "grd", "--out", str(tmp_path)]) == 2
    assert "only: there is no 'grd'; there are: first, embedded" in capsys.readouterr().err


def test_pages_are_written_when_all_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(everything, "call", lambda words: 0)
    monkeypatch.setattr(everything.pages, "STUDIES", {"speed": "speed"})
    monkeypatch.setattr(everything.pages, "write", lambda tables, docs: [docs / "results.md"])
    out, docs = tmp_path / "out", tmp_path / "docs"
    Table(out / "speed.csv").put([{"part": "step", "case": "3dgs", "threads": 2, "seconds": 0.25}])
    assert cli.main(["all", "--out", str(out), "--docs", str(docs)]) == 0
    assert Table(docs / "results" / "speed.csv").rows() == Table(out / "speed.csv").rows()


def test_new_lines_take_the_place_of_old_ones(tmp_path: Path) -> None:
    """What another program printed stays, and a table without new lines as it is."""
    old, new = tmp_path / "old", tmp_path / "new"
    Table(old / "time.csv").put([line("3dgs", 1.0), line("gone", 2.0), line("OpenSplat", 3.0)])
    Table(old / "quality.csv").put([line("3dgs", 4.0)])
    Table(new / "time.csv").put([line("3dgs", 5.0)])
    publish(new, old)
    assert [(row["row"], row["psnr"]) for row in Table(old / "time.csv").rows()] == [
        ("OpenSplat", "3"), ("3dgs", "5"),
    ]  # fmt: skip
    assert [row["psnr"] for row in Table(old / "quality.csv").rows()] == ["4"]
    assert not [path for path in old.iterdir() if path.suffix != ".csv"]
