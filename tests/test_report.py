"""The report's files: layout, pictures, chart, and what is left when writing fails."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from hqgs import get_num_threads
from hqgs.base import machine
from hqgs.evaluation import report
from hqgs.evaluation.held_out import RenderedView, measured
from hqgs.evaluation.metrics import METRICS, evaluate_view
from hqgs.evaluation.records import Report, RunRecord, read_report
from hqgs.evaluation.report import write_report

HEIGHT, WIDTH = 40, 60


def view_of(name: str, error: float = 0.1, mask: np.ndarray | None = None) -> RenderedView:
    """A grey photo of value 102 (0.4) and a render that is off by `error` everywhere."""
    photo = np.full((HEIGHT, WIDTH, 3), 102, np.uint8)
    return RenderedView(name, photo, np.full((HEIGHT, WIDTH, 3), 0.4 + error, np.float32), mask)


def written(out: Path, *views: RenderedView, **changes: Any) -> Report:
    """The report of a run with these held-out views."""
    record: dict[str, Any] = {
        "scene": "desk",
        "source": "colmap",
        "notes": ["one note"],
        "method": "3dgs",
        "seed": 7,
        "iterations": 300,
        "seconds": 12.5,
        "gaussians": 1234,
        "peak_rss_mb": 456.5,
        "history": [
            {"iteration": 100, "seconds": 4.0, "psnr": 18.0, "ssim": 0.6},
            {"iteration": 300, "seconds": 12.5, "psnr": 21.0, "ssim": None},
        ],
        "length": 400,
        "left_out": [{"what": "pose refinement", "why": "off by default"}],
        "scene_bytes": 4321,
        "config": {"iterations": 300, "lr": 1e-3},
        "guard": {"skipped_steps": 0, "culled_gaussians": 0, "num_events": 0, "events": []},
        "world": None,
        "place": None,
        "sfm": None,
        "photos": [],
        "ranks": [],
        "learned": [],
        "plan": [],
    }
    got = write_report(out, cast(RunRecord, record | changes), list(views))
    assert {key: got[key] for key in record} == record | changes
    return got


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below the folder, hidden ones too, with its content."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def strict_json(text: str) -> Any:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_report_has_every_field_and_the_right_numbers(tmp_path: Path) -> None:
    returned = written(tmp_path / "out", view_of("a.jpg", 0.1), view_of("b.jpg", 0.01))
    got = strict_json((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert got == returned == read_report(tmp_path / "out" / "report.json")

    assert [v["name"] for v in got["metrics"]["views"]] == ["a.jpg", "b.jpg"]
    assert [v["psnr"] for v in got["metrics"]["views"]] == pytest.approx([20, 40], abs=1e-4)
    assert got["metrics"]["mean"]["psnr"] == pytest.approx(30, abs=1e-4)  # of the views, not of the MSE
    assert got["metrics"]["mean"].keys() == set(METRICS)
    for values in (got["metrics"]["mean"], *got["metrics"]["views"]):
        missing = {m for m in METRICS if values[m] is None}
        assert missing <= got["metrics"]["reasons"].keys()

    assert (got["scene"], got["seed"], got["length"]) == ("desk", 7, 400)
    assert got["history"][1] == {"iteration": 300, "seconds": 12.5, "psnr": 21.0, "ssim": None}
    assert got["config"] == {"iterations": 300, "lr": 1e-3}
    assert got["versions"]["numpy"] == np.__version__
    assert got["machine"]["cores"] >= 1


def test_infinite_psnr_is_null_with_a_reason(tmp_path: Path) -> None:
    photo = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    perfect = RenderedView("same", photo, np.ones((HEIGHT, WIDTH, 3), np.float32))
    got = written(tmp_path, perfect, view_of("other"))
    assert got["metrics"]["views"][0]["psnr"] is None
    assert got["metrics"]["mean"]["psnr"] is None
    assert got["metrics"]["reasons"]["psnr"] == (
        "1 of 2 views: render and photo are identical (infinite PSNR)"
    )
    strict_json((tmp_path / "report.json").read_text(encoding="utf-8"))


def test_comparison_shows_photo_render_and_amplified_difference(tmp_path: Path) -> None:
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :10] = False
    got = written(tmp_path, view_of("images/a.jpg", 0.1, mask), view_of("b", -0.5))
    assert [v["picture"] for v in got["metrics"]["views"]] == ["comparison/images_a.png", "comparison/b.png"]

    with Image.open(tmp_path / "comparison" / "images_a.png") as file:
        picture = np.asarray(file.convert("RGB")).astype(int)
    caption = picture.shape[0] - HEIGHT
    assert picture.shape[1] == 3 * WIDTH + 16
    assert 12 <= caption <= 40
    photo, render, difference = (
        picture[caption:, i * (WIDTH + 8) : i * (WIDTH + 8) + WIDTH] for i in range(3)
    )
    assert (photo == 102).all()
    assert (abs(render - 127.5) <= 0.5).all()
    assert (difference[:, 10:] == 102).all()  # 4 x 0.1
    assert len({tuple(pixel) for pixel in difference[:, :10].reshape(-1, 3)}) == 1
    assert (difference[0, 0] != 0).all()  # masked out does not look like "no difference"
    for i in range(3):  # each panel has its caption, none runs into the gap
        start = i * (WIDTH + 8)
        assert picture[:caption, start : start + WIDTH].min() < 100
        assert (picture[:, start + WIDTH : start + WIDTH + 8] == 255).all()

    with Image.open(tmp_path / "comparison" / "b.png") as file:
        clamped = np.asarray(file.convert("RGB"))
    assert (clamped[-1, WIDTH + 8] == 0).all()  # render -0.1 is shown as black
    assert (clamped[-1, -1] == 255).all()  # 4 x 0.4 is cut at white


def test_hostile_view_names_stay_in_the_folder(tmp_path: Path) -> None:
    names = [
        "../../outside.png",
        "/etc/passwd",
        "..",
        "",
        ".hidden.jpg",
        "a/b.JPG",
        "A_B.jpg",
        "a\\b",
        "new\nline",
        "null\0byte",
        "日本語.png",
        "\udcff",
        "x" * 400,
        "con trol\x1b[31m $\\alpha$",
        "report.json",
    ]
    out = tmp_path / "deep" / "er" / "out"
    got = written(out, *(view_of(name) for name in names))
    files = tree(tmp_path)
    pictures = [f"deep/er/out/{v['picture']}" for v in got["metrics"]["views"]]
    assert len({p.lower() for p in pictures}) == len(names)
    assert set(files) == {*pictures, "deep/er/out/report.json"}
    for picture in pictures:
        name = Path(picture).name
        assert name.isascii()
        assert name.isprintable()
        assert not name.startswith(".")
        assert len(name) <= 90
    read = read_report(out / "report.json")
    assert [v["name"] for v in read["metrics"]["views"]] == names


@pytest.mark.parametrize("broken", ["comparison_picture", "write_json"])
def test_failure_midway_leaves_the_old_report_and_no_scraps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    written(tmp_path, view_of("a"), view_of("b"))
    before = tree(tmp_path)

    calls = 0
    works = getattr(report, broken)

    def fails(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if broken == "comparison_picture" and calls == 1:
            return works(*arguments)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report, broken, fails)
    with pytest.raises(OSError, match="No space left"):
        written(tmp_path, view_of("a", 0.2), view_of("b", 0.2), seed=8)
    assert calls
    assert tree(tmp_path) == before
    assert not list(tmp_path.glob(".report.*"))

    (tmp_path / ".report.killed").mkdir()  # what a killed process leaves goes with the next report
    (tmp_path / ".report.killed.html").write_text("<html>")
    monkeypatch.undo()
    written(tmp_path, view_of("a", 0.2), seed=9)
    assert not list(tmp_path.glob(".report.*"))


def test_report_json_is_there_only_with_everything_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path, view_of("a"))
    moved: list[str] = []
    replace = Path.replace

    def recording(self: Path, target: Path) -> Path:
        if Path(target).is_relative_to(tmp_path) and not str(target).count(".report."):
            moved.append(Path(target).relative_to(tmp_path).as_posix())
            assert not (tmp_path / "report.json").exists()
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", recording)
    written(tmp_path, view_of("a"), view_of("b"))
    assert moved == ["comparison/a.png", "comparison/b.png", "report.json"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": {"lr": math.nan}}, "RunRecord.config cannot be written as JSON"),
        ({"seconds": math.inf}, "RunRecord.seconds"),
        ({"config": {"path": Path("x")}}, "RunRecord.config"),
    ],
)
def test_a_field_that_is_no_json_is_named_before_work_starts(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        written(tmp_path / "out", view_of("a"), **changes)
    assert not (tmp_path / "out").exists()


def test_each_view_is_rendered_once_and_few_are_held() -> None:
    views = [view_of(f"{k}", 0.01 * k + 0.01) for k in range(12)]
    asked: list[int] = []
    drawn: list[int] = []

    class Rendered(list[RenderedView]):
        def __getitem__(self, number: Any) -> Any:
            assert len(asked) - len(drawn) <= get_num_threads() + 1
            asked.append(number)
            return super().__getitem__(number)

    found = measured(Rendered(views), lambda number, view, _: drawn.append(int(view.name) * (number + 1)))
    assert asked == list(range(12))
    assert sorted(drawn) == [k * (k + 1) for k in range(12)]
    assert found == [evaluate_view(view.render, view.photo) for view in views]

    def fails(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        measured(views, fails)


def test_a_bad_view_is_named(tmp_path: Path) -> None:
    bad = RenderedView("b.jpg", np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.float32))
    with pytest.raises(ValueError, match=r"view 'b.jpg': render has shape \[4, 5, 3\]"):
        written(tmp_path / "out", view_of("a"), bad)
    assert not (tmp_path / "out").exists()


def test_scene_without_held_out_views_gets_a_report(tmp_path: Path) -> None:
    got = written(tmp_path)
    assert got["metrics"]["mean"] == dict.fromkeys(METRICS)
    assert got["metrics"]["reasons"] == dict.fromkeys(METRICS, "there is no held-out photo")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not valid JSON"),
        ("[]", "is not an hqgs report: it has no metrics"),
        ('{"metrics": {"mean": {}}}', "its metrics lack reasons, views"),
    ],
)
def test_read_report_refuses_other_files(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "report.json").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_report(tmp_path / "report.json")
    with pytest.raises(FileNotFoundError):
        read_report(tmp_path / "none.json")


def test_machine_facts_name_no_host_user_or_path() -> None:
    facts = machine.machine_facts()
    assert facts.keys() == {"cpu", "simd", "cores", "memory_gib", "system", "architecture"}
    assert facts["cpu"]
    for value in (*facts.values(), *machine.version_facts().values()):
        assert value != socket.gethostname()
        assert not str(value).startswith(("/", "\\"))


def test_git_commit_is_that_of_a_checkout_only(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    assert machine._git_commit(tmp_path) is None
    git("init", "-q")
    (tmp_path / "pyproject.toml").write_text("[project]\n", encoding="utf-8")
    assert machine._git_commit(tmp_path) is None  # no commit yet
    git("add", "pyproject.toml")
    git("commit", "-q", "-m", "first")
    assert machine._git_commit(tmp_path) == git("rev-parse", "HEAD")
    (tmp_path / "untracked").touch()
    assert machine._git_commit(tmp_path) == git("rev-parse", "HEAD")
    (tmp_path / "pyproject.toml").write_text("changed\n", encoding="utf-8")
    assert machine._git_commit(tmp_path) == git("rev-parse", "HEAD") + "-dirty"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_memory_is_that_of_this_process() -> None:
    before = machine.peak_rss_mb()
    block = np.ones(40_000_000)  # 320 MB
    after = machine.peak_rss_mb()
    del block
    assert before is not None
    assert after is not None
    assert after >= 320
    code = f"import runpy; print(runpy.run_path({machine.__file__!r})['peak_rss_mb']())"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert float(shown) < 100  # the parent's peak does not count
