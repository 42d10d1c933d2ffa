"""README, CONTRIBUTING, CHANGELOG, docs and examples: what they name is there, what they show runs."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from docs_claims import PAGES, ROOT, wrong_claims, wrong_command
from fixtures_scenes import make_truth, write_colmap
from PIL import Image
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import write_degraded_scene
from hqgs.training.config import AUTOMATIC

RESULTS = {ROOT / "docs" / "results.md", ROOT / "docs" / "log.md", *ROOT.glob("docs/results/*.md")}
GUIDE = set(ROOT.glob("docs/**/*.md")) - RESULTS


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_everything_that_a_page_names_exists(page: Path) -> None:
    assert wrong_claims(page.read_text(encoding="utf-8"), page.parent) == []


@pytest.mark.parametrize(
    ("pages", "most"),
    [({ROOT / "README.md"}, 700), ({ROOT / "CHANGELOG.md"}, 600), (GUIDE, 9_300)],
    ids=["README", "CHANGELOG", "guide and how it works"],
)
def test_pages_are_short_enough_to_be_read(pages: set[Path], most: int) -> None:
    """Words as `wc -w` counts them."""
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= most


@pytest.mark.parametrize(
    "page",
    [
        "see `hqgs/scene/load.py`, `rust/`, `docs/results/*.csv` and [the README](README.md)",
        "`train --sfm`, `--leave-out none`, `python -m hqgs export`, `uv run pytest tests/test_docs.py`",
        "`hqgs.rasterization`, `hqgs.scene.load.load_scene`, `Scene.seen`; not `report.json`, `NAME.txt`",
        "```sh\nuv run python -m hqgs train FOLDER --out DIR  # a comment\n```",
        "```python\nimport hqgs\nhqgs.set_num_threads(2)\n```",
    ],
)
def test_what_exists_is_not_found_wrong(page: str) -> None:
    assert wrong_claims(page) == []


@pytest.mark.parametrize(
    ("page", "wrong"),
    [
        ("see `hqgs/scene/laod.py`", "path hqgs/scene/laod.py"),
        ("see `methods.py`", "path methods.py"),
        ("see [that page](docs/nowhere.md#here)", "link to docs/nowhere.md"),
        ("`uv run pytest tests/test_nothing.py`", "path tests/test_nothing.py"),
        ("`train --no-such-flag`", "flag --no-such-flag"),
        ("`--no-such-flag`", "flag --no-such-flag"),
        ("`--guidance papr`", "--guidance papr"),
        ("`uv run python -m hqgs trian FOLDER`", "command trian"),
        ("`python -m benchmarks qualty --sfm`", "command qualty"),
        ("`bench quality --sfm`", "command bench"),
        ("`examples/train_llff.py --epochs 3`", "examples/train_llff.py --epochs"),
        ("`cargo bench --bench nothing`", "cargo --bench nothing"),
        ("`hqgs.rasterise`", "name hqgs.rasterise"),
        ("`TrainConfig.selective_atom`", "name TrainConfig.selective_atom"),
        ("```python\nhqgs.rasterise(means)\n```", "name hqgs.rasterise"),
        ("```sh\npython -m hqgs train FOLDER\n```", "--out"),  # which it cannot do without
        ("```sh\npython -m hqgs diagnose FOLDER --down 2\n```", "--down"),  # no shortened flag
        ("```sh\npython -m benchmarks quality --seeds none\n```", "--seeds"),
        ("```sh\npip install -q uv && uv run examples/nothing.py\n```", "path examples/nothing.py"),
    ],
)
def test_what_does_not_exist_is_found(page: str, wrong: str) -> None:
    (found,) = wrong_claims(page)
    assert wrong in found


def test_a_report_with_a_flag_that_is_gone_is_found() -> None:
    (found,) = wrong_command(["python", "-m", "benchmarks", "quality", "--scene-of-old", "fern"])
    assert "--scene-of-old" in found


# --- The README's Python lines run as printed


def blocks() -> list[str]:
    text = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def test_the_lines_of_the_product_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a small scene, and with fewer iterations."""
    write_colmap(make_truth(), tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    block = blocks()[0]
    assert "iterations=3000" in block
    exec(block.replace("iterations=3000", "iterations=20"), names)
    assert names["run"].iterations == 20
    assert (tmp_path / "run" / "report.json").exists()
    camera = names["scene"].test[0].camera
    assert names["image"].shape == (camera.height, camera.width, 3)
    assert torch.equal(names["model"].means, names["run"].model.means)


def test_the_lines_of_the_rasterizer_run() -> None:
    names: dict[str, Any] = {}
    torch.manual_seed(0)
    exec(blocks()[1], names)
    assert names["image"].shape == (1, 240, 320, 3)
    assert names["alpha"].max() > 0.5
    assert names["colors"].grad.abs().sum() > 0


# --- The examples run at a tiny size, are short, and do what they say


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
