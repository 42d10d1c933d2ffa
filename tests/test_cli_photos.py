"""`hqgs sfm`, `diagnose` and `info` on photos alone, as a user has them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hqgs.cli.main import main
from hqgs.scene.load import load_scene


def call(*arguments: str | Path) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture
def folder(photos: list[np.ndarray], tmp_path: Path) -> Path:
    """Photos and a text that is none."""
    path = tmp_path / "photos"
    path.mkdir()
    for k, image in enumerate(photos):
        Image.fromarray(image).save(path / f"{k}.{'webp' if k % 2 else 'png'}", lossless=True)
    (path / "zz.png").write_text("a text")
    return path


def test_sfm_writes_a_folder_that_trains(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene"
    (out / ".sfm").mkdir(parents=True)  # of a call that was stopped
    assert call("sfm", folder, "--out", out) == 0
    printed = capsys.readouterr().out
    assert "9 of 9 registered" in printed
    assert "zz.png (no picture)" in printed
    assert sorted(path.name for path in out.iterdir()) == ["images", "sparse"]
    assert sorted(path.name for path in (out / "images").iterdir())[:2] == ["0.png", "1.webp.jpg"]
    scene = load_scene(out)
    assert scene.source == "colmap"
    assert len(scene.train) + len(scene.test) == 9
    assert call("sfm", folder, "--out", out) == 2
    assert "is not an empty folder" in capsys.readouterr().err


def test_diagnose_and_info_need_no_cameras(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("diagnose", folder, "--out", tmp_path / "d.json") == 0
    assert "cannot be read (1): zz.png" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "d.json").read_text())["photos"]) == 9
    assert call("info", folder) == 0
    printed = capsys.readouterr().out
    assert "9 photos of 192 x 144 px" in printed
    assert "poses: none yet" in printed
    assert call("info", tmp_path / "d.json") == 2
