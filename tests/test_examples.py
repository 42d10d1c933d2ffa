"""The examples run at a tiny size, are short, and do what they say."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import write_degraded_scene
from hqgs.training.config import AUTOMATIC

EXAMPLES = Path(__file__).parent.parent / "examples"
LONGEST = 80  # lines

Run = Callable[..., str]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene folder of six photos, 24 x 16."""
    write_degraded_scene(tiny_scene(), tmp_path / "desk", parse_degradation("none"), 0)
    return tmp_path / "desk"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs an example in an empty folder; returns what it says."""

    def run(name: str, *arguments: str | Path) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_examples_are_short() -> None:
    files = sorted(EXAMPLES.glob("*.py"))
    assert len(files) >= 3
    for file in files:
        assert len(file.read_text(encoding="utf-8").splitlines()) <= LONGEST, file.name
        assert f"def test_{file.stem}(" in Path(__file__).read_text(encoding="utf-8")


def test_train_llff(run: Run, folder: Path, tmp_path: Path) -> None:
    told = run("train_llff.py", folder, "--iterations", "20")
    out = tmp_path / "outputs" / "desk"
    report = json.loads((out / "report.json").read_text())
    assert (report["method"], report["iterations"]) == ("hqgs", 20)
    assert report["config"]["leave_out"] == list(AUTOMATIC)
    assert f"{report['gaussians']} Gaussians after 20 iterations" in told
    assert f"psnr  {report['metrics']['mean']['psnr']:.4f}" in told
    assert len(list((out / "comparison").iterdir())) == 1
    again = run("train_llff.py", folder, "--iterations", "10")
    assert "after 10 iterations" in again


def test_bad_photos(run: Run, folder: Path, tmp_path: Path) -> None:
    told = run("bad_photos.py", folder, "--iterations", "50", "--downscale", "1", "--kind", "noise:40")
    assert "\ndesk: none\n" in told  # the diagnosis: photos of this size tell nothing
    (trained,) = re.findall(r"iteration 50 of 50: ([\d.]+) dB", told)
    out = tmp_path / "outputs" / "bad_photos"
    assert {file.name for file in out.iterdir()} == {"scene.ply", "scene.spz", "render.png"}
    shown = np.asarray(Image.open(out / "render.png")) / 255.0
    assert shown.shape == (16, 24, 3)
    error = np.square(shown - tiny_scene().test[0].image / 255.0).mean()  # of the only held-out view
    assert -10 * np.log10(error) == pytest.approx(float(trained), abs=0.05)


def test_fit_picture(tmp_path: Path) -> None:
    """As a program of its own."""
    options = ("--size", "32", "--gaussians", "200", "--iterations", "60", "--out", "a.png")
    command = [sys.executable, str(EXAMPLES / "fit_picture.py"), *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = [float(value) for value in re.findall(r"([\d.]+) dB", done.stdout)]
    assert len(told) == 10
    assert told[-1] > told[0] + 3
    assert Image.open(tmp_path / "a.png").size == (64, 32)


def test_look(run: Run, tmp_path: Path) -> None:
    hqgs.train(tiny_scene(), out=tmp_path / "run", config=tiny_config())
    told = run("look.py", tmp_path / "run", "--frames", "5")
    assert "5 frames: outputs/look" in told
    names = {file.name for file in (tmp_path / "outputs" / "look").iterdir()}
    assert names == {"path.mp4", "orbit.gif", "wide.png"}
    wide = np.asarray(Image.open(tmp_path / "outputs" / "look" / "wide.png"))
    assert wide.shape == (270, 480, 3)
    assert wide.std() > 2  # a young scene is thin
