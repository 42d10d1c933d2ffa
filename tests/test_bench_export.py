"""The benchmark `export`: every file is measured as it is read back, and the front is the front."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_scene import tiny_scene

from benchmarks import cli, protocol
from benchmarks import export as bench
from benchmarks.pages.figures import unbeaten
from benchmarks.rows import Table
from hqgs.evaluation.held_out import held_out_psnr, held_out_renders
from hqgs.model.gaussians import Gaussians


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
    points = [(row["bytes"], -row["psnr"]) for row in files.values()]
    assert {k for k, row in enumerate(files.values()) if row["pareto"]} == set(unbeaten(points))

    text = capsys.readouterr().out
    assert all(f"| {name} |" in text for name in files)
    assert text.startswith("Embedded, 24 x 16 px, ")
    assert not list(tmp_path.glob("tmp*"))


def test_the_front_holds_what_no_other_beats_in_both() -> None:
    pairs = [(10, 30.0), (5, 29.0), (5, 28.0), (7, 28.5), (1, 20.0), (1, 20.0), (12, 30.0)]
    assert unbeaten([(size, -psnr) for size, psnr in pairs]) == [4, 5, 1, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--downscale", "0.5"], "downscale must be at least 1, got 0.5"),
        (["--scenes", "a", "b"], "one scene and one seed are written"),
        (["--iterations", "0"], "iterations is 0, wanted at least 1"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: list[str],
    message: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(protocol, "embedded_scene", lambda *_, **__: tiny_scene())
    assert call(*arguments, "--out", tmp_path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
