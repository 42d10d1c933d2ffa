"""The benchmark `export`: every file is measured as it is read back, and the front is the front."""

from __future__ import annotations

import base64
import html
import io
import json
import re
from pathlib import Path

import pytest
from PIL import Image
from tiny_scene import tiny_scene

from benchmarks import cli, protocol
from benchmarks import export as bench
from benchmarks.output import unbeaten
from benchmarks.study import Store
from hqgs.evaluation.held_out import held_out_psnr, held_out_renders
from hqgs.model.gaussians import Gaussians


def call(*arguments: str | Path) -> int:
    return cli.main(["export", *map(str, arguments)])


def test_quick(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(protocol, "embedded_scene", lambda *args, **_: asked.append(args) or tiny_scene())
    assert call("--quick", "--out", tmp_path, "--page", tmp_path) == 2
    assert "is a folder: name a file" in capsys.readouterr().err
    page = tmp_path / "page.html"
    assert call("--quick", "--threads", "1", "--out", tmp_path, "--page", page) == 0
    assert asked == [(tmp_path / "scenes" / "embedded_42x32_24", 42, 32)]
    report = json.loads((tmp_path / "export.json").read_text(encoding="utf-8"))
    result = report["results"]
    files = {row["name"]: row for row in result["files"]}
    assert list(files) == list(bench.VARIANTS)
    (folder,) = (path for path in Store(tmp_path).here.iterdir() if path.is_dir())
    scene, trained = tiny_scene(), Gaussians.load(folder)
    assert result["psnr"] == pytest.approx(held_out_psnr(scene, held_out_renders(scene, trained)))
    assert result["gaussians"] == len(trained)
    assert report["settings"]["iterations"] == 20

    exact = files["ply, degree 3"]
    assert (exact["cost_db"], exact["largest_change"], exact["psnr_to_original"]) == (0, 0, None)
    assert result["ply_of_3dgs_bytes"] == exact["bytes"] + 12 * len(trained)
    assert exact["bytes"] == (folder / "scene.ply").stat().st_size
    sizes = [files[f"ply, degree {d}"]["bytes"] for d in (3, 2, 1, 0)]
    assert sizes == sorted(sizes, reverse=True)
    fine, coarse = (files[f"spz, {bits} bits, tolerance 0"] for bits in ("8 and 8", "5 and 4"))
    assert coarse["bytes"] <= fine["bytes"] < exact["bytes"] / 3
    assert abs(fine["cost_db"]) < 0.1
    for row in files.values():
        assert row["psnr"] == pytest.approx(result["psnr"] - row["cost_db"])
        assert 0 <= row["largest_change"] < 0.2

    text = capsys.readouterr().out
    assert all(name in text for name in files)
    with Image.open(tmp_path / "export_size.png") as chart:
        assert chart.size == (1200, 750)
    assert not list(tmp_path.glob("tmp*"))

    shown = page.read_text(encoding="utf-8")
    for row in text.splitlines():  # each cell of what was printed, and the chart
        if row.startswith("|") and "---" not in row:
            assert all(f">{cell.strip()}<" in html.unescape(shown) for cell in row.strip("|").split(" | "))
    assert f"<code>{report['command']}</code>" in shown
    assert f"commit {report['commit']}; 1 threads" in shown
    picture = re.search(r'src="data:image/png;base64,([^"]+)"', shown)
    assert picture is not None
    with Image.open(io.BytesIO(base64.b64decode(picture[1]))) as chart:
        assert chart.size == (1200, 750)
    assert "://" not in shown  # nothing of it lies elsewhere


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
