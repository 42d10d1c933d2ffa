"""The benchmarks `parts`, `all`, `export` and `time` at tiny sizes."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from pandas import DataFrame
from tiny_scene import tiny_scene

import hqgs
from benchmarks import cli, everything, protocol
from benchmarks import export as bench
from benchmarks.everything import command_of, publish
from benchmarks.pages.write import STUDIES
from benchmarks.parts import ALL, PARTS, alone, gains_of, length, lines_of, parts_table
from benchmarks.rows import RUN, Table, pairs_of
from benchmarks.without import VARIABLE, function_at, without
from hqgs.base.text import some
from hqgs.evaluation.held_out import held_out_psnr, held_out_renders
from hqgs.model.gaussians import Gaussians

PLACE = "hqgs.base.text:some"


@pytest.mark.parametrize("label", PARTS)
def test_what_a_part_names_is_there(label: str) -> None:
    part = PARTS[label]
    assert part.what
    assert lines_of(part) >= 5 * len(part.modules)
    with without(part.without):
        assert part.train_config(0, 100).method == "auto"
    for place in part.without:
        assert function_at(place).__code__.co_name != "neutral"  # it is back
    assert label == ALL or part.without or part != PARTS[ALL]


def test_whoever_imported_a_function_calls_the_other_one() -> None:
    before = some(["a", "b"])
    with without({PLACE: "(was(*args), len(args[0]))"}):
        assert some(["a", "b"]) == (before, 2)
        said = subprocess.run(
            [sys.executable, "-c", "from hqgs.base.text import some; print(some('abc')[1])"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert said.stdout == "3\n"
    assert some(["a", "b"]) == before
    assert VARIABLE not in os.environ
    with (
        pytest.raises(ValueError, match=r"there is no hqgs\.base\.text:gone"),
        without({"hqgs.base.text:gone": "0"}),
    ):
        pass


def test_lines_are_those_of_a_part_alone() -> None:
    """`align` is imported by `reconstruct` alone; what others import, too, stays."""
    assert alone(["hqgs.scene.sfm.reconstruct"]) > {"hqgs.scene.sfm.align"}
    assert "hqgs.base.text" not in alone(["hqgs.cli.plan"])
    file = Path(hqgs.__file__).parent / "base" / "text.py"
    assert length("hqgs.base.text") == len(file.read_text(encoding="utf-8").splitlines())


def test_a_part_gains_only_where_it_is_on() -> None:
    rows = [
        ("a", ALL, 20.0, True),
        ("a", "discs", 19.0, True),
        ("b", ALL, 30.0, True),
        ("b", "discs", 30.0, False),
    ]
    runs = DataFrame(rows, columns=["scene", "row", "psnr", "on"]).assign(
        degradation="none",
        seed=0,
        iterations=1,
        downscale=1,
        poses="own",
        ssim=0.5,
        cpu_seconds=2.0,
        placed=3,
        lines=7,
        what="flat",
    )
    assert (gains_of(runs, "discs").mean, gains_of(runs, "discs").count) == (1.0, 1)
    assert "| discs: flat | 7 | 1 of 2 | +1.00 | – | – | +0.000 | +0 |" in parts_table(runs)


# --- `all`: every study behind the pages is run once, and its lines take the place of those of the pages


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


class Ended:
    """A process."""

    def __init__(self, *codes: int | None) -> None:
        self.codes = list(codes)

    def poll(self) -> int | None:
        return self.codes.pop(0)

    def terminate(self) -> None:
        self.codes = [130]

    def wait(self) -> int:
        return self.codes[0] or 0


def test_studies_of_one_thread_run_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    course = {"a": Ended(None, None, 0), "b": Ended(None, 0), "c": Ended(None), "d": Ended(0)}
    started = list[str]()
    monkeypatch.setattr(everything, "start", lambda words: started.append(words[0]) or course[words[0]])
    monkeypatch.setattr(everything, "PAUSE", 0)
    studies = everything.side_by_side({name: [name] for name in course}, 2, [])
    assert (next(studies)[:2], started) == (("b", 0), ["a", "b"])
    assert (next(studies)[:2], started) == (("a", 0), ["a", "b", "c"])
    studies.close()  # by Ctrl-C
    assert course["c"].codes == [130]
    assert started == ["a", "b", "c"]


def test_what_is_done_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    called: list[str] = []
    codes = {"speed": 1}

    def start(words: list[str]) -> Ended:
        called.append(words[0])
        assert words[1:] == ["--quick", "--out", str(tmp_path)]
        return Ended(codes.get(words[0], 0))

    monkeypatch.setattr(everything, "start", start)
    monkeypatch.setattr(everything, "PAUSE", 0)
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
    assert "only: there is no 'grd'; there are: standard, others" in capsys.readouterr().err


def test_pages_are_written_when_all_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(everything, "start", lambda words: Ended(0))
    monkeypatch.setattr(everything.pages, "STUDIES", {"speed": "speed"})
    monkeypatch.setattr(everything.pages, "write", lambda tables, docs: [docs / "results.md"])
    out, docs = tmp_path / "out", tmp_path / "docs"
    Table(out / "speed.csv").put([{"part": "step", "case": "3dgs", "threads": 2, "seconds": 0.25}])
    assert cli.main(["all", "--out", str(out), "--docs", str(docs)]) == 0
    assert Table(docs / "results" / "speed.csv").rows() == Table(out / "speed.csv").rows()


def test_new_tables_take_the_place_of_old_ones(tmp_path: Path) -> None:
    """A table without new lines stays as it is."""
    old, new = tmp_path / "old", tmp_path / "new"
    Table(old / "time.csv").put([line("3dgs", 1.0), line("gone", 2.0)])
    Table(old / "quality.csv").put([line("3dgs", 4.0)])
    Table(new / "time.csv").put([line("3dgs", 5.0)])
    publish(new, old)
    assert [(row["row"], row["psnr"]) for row in Table(old / "time.csv").rows()] == [("3dgs", "5")]
    assert [row["psnr"] for row in Table(old / "quality.csv").rows()] == ["4"]
    assert not [path for path in old.iterdir() if path.suffix != ".csv"]


# --- The benchmark `export`: every file is measured as it is read back, and the front is the front


def call(*arguments: str | Path) -> int:
    return cli.main(["export", *map(str, arguments)])


def test_quick(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(protocol, "embedded_scene", lambda *args, **_: asked.append(args) or tiny_scene())
    assert call("--quick", "--threads", "1", "--out", tmp_path) == 0
    assert asked == [(tmp_path / "scenes" / "embedded_42x32_24", 42, 32)]
    files = {row["file"]: row for row in Table(tmp_path / "export.csv").frame().to_dict("records")}
    assert list(files) == list(bench.VARIANTS)
    (folder,) = (tmp_path / "runs").iterdir()
    scene, trained = tiny_scene(), Gaussians.load(folder)

    exact = files["ply, degree 3"]
    assert (exact["cost_db"], exact["largest_change"]) == (0, 0)
    assert exact["psnr"] == pytest.approx(held_out_psnr(scene, held_out_renders(scene, trained)), abs=1e-4)
    assert exact["gaussians"] == len(trained)
    assert exact["ply_bytes"] == exact["bytes"] + 12 * len(trained)
    assert exact["bytes"] == (folder / "scene.ply").stat().st_size
    sizes = [files[f"ply, degree {d}"]["bytes"] for d in (3, 2, 1, 0)]
    assert sizes == sorted(sizes, reverse=True)
    fine, coarse = (files[f"spz, {bits} bits, tolerance 0"] for bits in ("8 and 8", "5 and 4"))
    assert coarse["bytes"] <= fine["bytes"] < exact["bytes"] / 3
    assert abs(fine["cost_db"]) < 0.1
    for row in files.values():
        assert row["psnr"] == pytest.approx(exact["psnr"] - row["cost_db"], abs=1e-3)
        assert 0 <= row["largest_change"] < 0.2

    text = capsys.readouterr().out
    assert all(f"| {name} |" in text for name in files)
    assert text.startswith("Embedded, 24 x 16 px, ")
    assert not list(tmp_path.glob("tmp*"))


# --- The benchmark `time`: runs that have seconds, and one that keeps its course


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


# --- What all say of bad options


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("accuracy --quick --repeats 0", "repeats is 0, wanted at least 1"),
        ("speed --quick --repeats 0", "repeats is 0, wanted at least 1"),
        ("speed --quick --threads 0", "threads"),
        ("export --scenes a b", "one scene and one seed are written"),
        ("export --iterations 0", "iterations is 0, wanted at least 1"),
        ("endurance --quick --downscale 60", "downscale must be in 1..47.25 for embedded, got 60"),
        ("endurance --quick --rows none", "rows: there is no 'none'; there are: as it is, "),
        ("quality --quick --rows nerf", "rows: there is no 'nerf'; there are: 3dgs, srgs, hqgs"),
        ("quality --quick --degradations fog", "unknown degradation 'fog'"),
        ("quality --quick --degradations blur blur", "degradations holds blur twice"),
        ("quality --quick --seeds -1", "seed is -1, wanted at least 0"),
        ("quality --quick --downscale 0.5", "downscale must be at least 1, got 0.5"),
        ("quality --quick --pictures -1", "pictures is -1"),
        ("quality --quick --scenes no", "there is no scene folder"),
    ],
)
def test_bad_options_are_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, message: str
) -> None:
    assert cli.main([*arguments.split(), "--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"hqgs: {message}")
    assert not list(tmp_path.glob("*.csv"))
