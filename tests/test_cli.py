"""The command line: exit codes, one-line errors, and what it leaves in the folder."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fixtures_scenes import make_truth, write_transforms
from PIL import Image
from planned import run_config
from tiny_scene import tiny_scene

import hqgs
from hqgs.base.files import CHECKPOINT, lock_folder
from hqgs.base.stages import Stage
from hqgs.cli import main as cli
from hqgs.cli import progress
from hqgs.cli.progress import LoadingScreen, TrainingScreen
from hqgs.model.gaussians import Gaussians
from hqgs.scene import source
from hqgs.scene.load import load_scene
from hqgs.scene.scene import Scene, SfmReport
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.plan import RunPlan
from hqgs.training.schedule import Schedule
from hqgs.training.trainer import seconds_left


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The tiny scene in place of the embedded one; the list gets the arguments that it was asked with."""
    calls: list[dict[str, Any]] = []

    def embedded(width: int, height: int) -> Scene:
        calls.append({"size": (width, height)})
        return tiny_scene()

    monkeypatch.setattr(source, "embedded_scene", embedded)
    return calls


def call(*arguments: str | Path) -> int:
    return cli.main([str(argument) for argument in arguments])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The only line on stderr."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]


def test_train_the_embedded_scene(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "out"
    options = ["--iterations", "20", "--seed", "3", "--max-gaussians", "55", "--eval-every", "7"]
    options += ["--method", "3dgs"]
    assert call("train", "embedded", "--out", out, "--downscale", "2", *options) == 0
    assert asked == [{"size": (252, 189)}]
    report = json.loads((out / "report.json").read_text())
    assert (report["iterations"], report["seed"], report["method"]) == (20, 3, "3dgs")
    assert report["config"]["densify"]["max_gaussians"] == 55
    assert [h["iteration"] for h in report["history"]] == [7, 14, 20]
    gaussians = len(Gaussians.load(out / "scene.ply"))
    assert f"{out}: 20 iterations, {gaussians} Gaussians, " in capsys.readouterr().out


def test_train_on_degraded_photos(asked: list[dict[str, Any]], tmp_path: Path) -> None:
    options = ["--iterations", "2", "--seed", "3", "--degrade", "noise:25"]
    assert call("train", "embedded", "--out", tmp_path, *options) == 0
    (note,) = json.loads((tmp_path / "report.json").read_text())["notes"]
    assert note.startswith("degradation noise:25, seed 3: all training photos (5), ")
    assert call("train", "embedded", "--out", tmp_path, *options, "--resume") == 0
    assert call("train", "embedded", "--out", tmp_path, *options[:-1], "noise:24", "--resume") == 2


@pytest.mark.parametrize(("form", "kind"), [("colmap", "none"), ("photos", "none"), ("photos", "noise:9")])
def test_sfm_replaces_poses_and_points_once(
    form: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder of photos alone has its poses from clean photos already; degraded ones give others."""
    error = {"median": 0.1, "max": 0.2}
    report = SfmReport(5, ["lost.png"], 40, 3.5, 0.5, [], error, error, 0.4, 40)
    seen: list[Any] = []

    def load(path: str, downscale: float, **_: Any) -> Scene:
        return replace(tiny_scene(), source=form)

    def sfm(scene: Scene, keep: Path, told: Any) -> Scene:
        assert keep == tmp_path / "sfm"
        seen.append(scene.train[0].image.dtype)
        return replace(scene, sfm=report, notes=[str(report)])

    monkeypatch.setattr(source, "load_scene", load)
    monkeypatch.setattr(source, "sfm_scene", sfm)
    options = ["--sfm", "--degrade", kind, "--iterations", "2"]
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.png").touch()
    assert call("train", tmp_path / "pictures", "--out", tmp_path, *options) == 0
    written, printed = json.loads((tmp_path / "report.json").read_text()), capsys.readouterr().out
    if (form, kind) == ("photos", "none"):
        assert seen == []
        assert written["sfm"] is None
    else:
        assert seen == [np.uint8 if kind == "none" else np.float32]
        assert written["sfm"] == asdict(report)
        assert "4 of 5 registered" in printed
        assert "lost.png" in printed


def test_degrade_writes_a_scene_that_trains(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad"
    command = ["degrade", "embedded", "--kind", "lowres:2+jpeg:30", "--out", bad, "--downscale", "2"]
    assert call(*command, "--seed", "4") == 0
    assert asked == [{"size": (252, 189)}]
    told = capsys.readouterr().out
    assert told.endswith(f"{bad}: 5 training photos with lowres:2+jpeg:30, 1 held out\n")
    assert json.loads((bad / "degradation.json").read_text())["seed"] == 4
    assert call("train", bad, "--iterations", "2", "--out", tmp_path / "run") == 0
    (note,) = json.loads((tmp_path / "run" / "report.json").read_text())["notes"]
    assert note.startswith("degradation lowres:2+jpeg:30, seed 4: ")
    capsys.readouterr()
    assert call(*command) == 2
    assert one_line(capsys) == f"hqgs: {bad} exists and is not an empty folder"


def test_diagnose_prints_and_writes_what_it_found(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "diagnosis.json"
    assert call("diagnose", "embedded", "--downscale", "2", "--out", out) == 0
    assert asked == [{"size": (252, 189)}]
    printed, written = capsys.readouterr().out, json.loads(out.read_text())
    assert len(written["photos"]) == 5
    assert len(written["parts"]) == 10
    assert all(view["name"] in printed for view in written["photos"])
    assert f": {written['formation']}\n" in printed
    assert call("diagnose", "/no/such/scene") == 2
    assert one_line(capsys).startswith("hqgs: there is no scene folder")


def test_a_folder_that_another_run_holds_stays_as_it_is(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cameras.json").write_text("of the other run")
    with lock_folder(tmp_path):
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        assert call("train", "embedded", "--out", tmp_path, "--view", "--port", "0") == 2
        assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert "another run is writing into" in one_line(capsys)


def test_what_lies_in_the_folder_of_a_new_run_is_named_or_kept(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "photos").mkdir()
    options = ["train", "embedded", "--out", tmp_path, "--iterations", "2"]
    assert call(*options, "--resume") == 0
    first, second = capsys.readouterr().out.splitlines()[:2]
    assert first == f"--resume: {tmp_path} holds no run; a new one starts"
    assert second.startswith(f"--out {tmp_path} also holds other files (notes.txt, photos): ")
    assert call(*options, "--overwrite") == 0  # a run of ours
    assert "other files" not in capsys.readouterr().out
    for name in ("config.json", "photos/a.jpg"):
        others = tmp_path / ("of " + name.replace("/", " "))
        (others / name).parent.mkdir(parents=True)
        (others / name).write_text("mine")
        wanted = f"{others} holds {name.partition('/')[0]}, not of a run, which a run would overwrite"
        assert call("train", "embedded", "--out", others, "--iterations", "2") == 2
        assert wanted in one_line(capsys)
        with pytest.raises(FileExistsError, match="would overwrite"):
            hqgs.train(tiny_scene(), out=others, iterations=2)
        assert [path for path in others.rglob("*") if path.is_file()] == [others / name]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train /no/such/scene", "there is no scene folder /no/such/scene"),
        ("train embedded --eval-every 0", "eval_every is 0, wanted at least 1"),
        ("train embedded --max-gaussians 9", "max_gaussians is 9, but the scene starts with 40 points"),
        ("train embedded --seed -1", "seed is -1, wanted at least 0"),
        ("train embedded --threads 0", "threads: must be 1 to 1024, got 0"),
        ("train embedded --method hqgs --formation fog", "unknown degradation 'fog'"),
        ("degrade /no/such/scene --kind blur", "there is no scene folder /no/such/scene"),
        ("degrade embedded --kind jpeg:0", "jpeg is 0, wanted a quality, an integer in 1..95"),
        ("degrade embedded --kind noise:9 --seed -1", "seed is -1, wanted at least 0"),
        ("degrade embedded --kind blur:20", "photo 'view1.png': a blur of sigma 20 px reaches 80 px"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2_and_leaves_no_folder(
    asked: list[dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    message: str,
) -> None:
    assert call(*command.split(), "--out", tmp_path / "deep" / "new") == 2
    assert one_line(capsys).startswith(f"hqgs: {message}")
    assert list(tmp_path.iterdir()) == []


def test_threads_are_set(asked: list[dict[str, Any]], tmp_path: Path) -> None:
    assert call("train", "embedded", "--out", tmp_path, "--iterations", "2", "--threads", "1") == 0
    assert hqgs.get_num_threads() == 1


def test_a_run_goes_on_with_resume_only(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "embedded", "--out", str(tmp_path), "--iterations", "20"]
    assert call(*command, "--resume") == 0  # nothing there yet: starts
    capsys.readouterr()
    assert call(*command) == 2
    assert one_line(capsys).startswith(f"hqgs: {tmp_path} holds a run: continue it with --resume, ")
    assert call(*command, "--resume") == 0
    capsys.readouterr()
    assert call(*command, "--resume", "--seed", "1") == 2
    assert "another seed: 0 there, 1 in this run" in one_line(capsys)
    assert call(*command[:-1], "19", "--resume") == 2
    wanted = (
        f"iterations is 19, and the run in {tmp_path} has 20: --resume can make a run longer, not shorter"
    )
    assert one_line(capsys) == f"hqgs: {wanted}"
    (tmp_path / CHECKPOINT).write_bytes(b"no checkpoint")
    assert call(*command, "--resume") == 2
    assert f"the checkpoint {tmp_path / CHECKPOINT} is damaged" in one_line(capsys)


def test_a_run_that_cannot_go_on_is_exit_code_1(
    asked: list[dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(self: ThreeDGS, render: Any, view: Any) -> Any:
        return render.sum() * float("nan")

    monkeypatch.setattr(ThreeDGS, "loss", broken)
    assert call("train", "embedded", "--out", tmp_path, "--method", "3dgs", "--iterations", "300") == 1
    assert "was NaN or Inf in 20 steps in a row" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("words", ["--help", "train --help", "info scene.ply"])
def test_output_that_nobody_reads_is_no_failure(words: str, tmp_path: Path) -> None:
    """As in `hqgs ... | head`, which has read enough."""
    Gaussians.from_points(np.eye(4, 3), np.zeros((4, 3), np.uint8), 0).save(tmp_path / "scene.ply")
    command = [sys.executable, "-m", "hqgs", *words.split()]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, said = process.communicate()
    assert process.returncode == 141
    assert b"Traceback" not in said
    assert b"BrokenPipe" not in said


@pytest.mark.parametrize(("words", "code"), [("--version", 0), ("nothing", 2), ("train --help", 0)])
def test_closed_output_is_no_failure(words: str, code: int) -> None:
    """As in `hqgs ... >&- 2>&-`."""
    line = f"{sys.executable} -m hqgs {words} >&- 2>&-"
    assert subprocess.run(["bash", "-c", line], check=False).returncode == code


def test_names_that_a_console_cannot_show_fail_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders of photos and of a run, whose names are no UTF-8, told on a console of ASCII."""
    photos = write_transforms(make_truth(4), tmp_path / os.fsdecode(b"caf\xe9"))
    run = tmp_path / os.fsdecode(b"\xc3\xa9t\xe9")
    told = io.BytesIO()
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, io.TextIOWrapper(told, "ascii", write_through=True))
    train = ["train", photos, "--out", run, "--method", "3dgs", "--iterations"]
    assert [call(*train, "2"), call("info", run), call(*train, "2")] == [0, 0, 2]
    assert b"\\xe9t\\udce9" in told.getvalue()
    assert {"report.json", "report.html", "scene.ply"} <= {path.name for path in run.iterdir()}


def test_ctrl_c_while_the_scene_is_read_is_exit_code_130(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupting(*arguments: Any) -> Scene:
        raise KeyboardInterrupt

    monkeypatch.setattr(source, "embedded_scene", interrupting)
    assert call("train", "embedded", "--out", tmp_path) == 130


def test_a_run_that_was_killed_before_its_checkpoint_is_asked_for_the_same(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", "embedded", "--out", tmp_path]
    assert call(*command, "--iterations", "2", "--method", "3dgs", "--seed", "5", "--downscale", "2") == 0
    for name in ("checkpoint.safetensors", "scene.ply", "report.json"):
        (tmp_path / name).unlink()
    capsys.readouterr()
    assert call(*command, "--resume") == 0
    assert capsys.readouterr().out.startswith(
        f"--resume: {tmp_path} holds a run without checkpoint: it starts"
    )
    config = json.loads((tmp_path / "config.json").read_text())
    assert [config["train"][name] for name in ("iterations", "method", "seed")] == [2, "3dgs", 5]
    assert asked[1] == asked[0]


def test_a_resumed_run_has_the_scene_that_it_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its size, its held-out views and its degradation, without saying them again."""
    calls: list[dict[str, Any]] = []

    def load(path: str, downscale: float, **more: Any) -> Scene:
        calls.append({"downscale": downscale, **more})
        return tiny_scene()

    monkeypatch.setattr(source, "load_scene", load)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").touch()
    command = ["train", tmp_path / "photos", "--out", tmp_path / "run"]
    options = ["--preset", "quick", "--iterations", "3", "--test-every", "5", "--degrade", "noise:9"]
    assert call(*command, *options) == 0
    assert (calls[0]["longest"], calls[0]["test_every"]) == (480, 5)
    assert call(*command, "--resume") == 0
    assert {**calls[1], "on_stage": None} == {**calls[0], "on_stage": None}
    assert call(*command, "--resume", "--iterations", "5") == 0
    assert json.loads((tmp_path / "run" / "report.json").read_text())["iterations"] == 5
    assert call(*command, "--resume", "--downscale", "2") == 0
    assert (calls[3]["longest"], calls[3]["downscale"]) == (None, 2.0)


def test_the_last_lines_say_how_good_it_is_and_what_to_do(
    asked: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("train", "embedded", "--out", tmp_path, "--iterations", "3") == 0
    *_, quality, time, send, now = capsys.readouterr().out.splitlines()
    assert quality.startswith("quality: poor (below 20 dB: ")
    assert "loading" in time
    assert "preparing" in time
    assert str(tmp_path / "report.html") in send
    assert send.endswith(
        f"SuperSplat (superspl.at/editor) and other 3DGS viewers open {tmp_path / 'scene.ply'}"
    )
    assert now == f"next, to see it: hqgs view {tmp_path}"
    assert call("info", tmp_path) == 0
    assert "3 of 3 iterations" in capsys.readouterr().out
    assert call("eval", tmp_path) == 0
    assert "fitted" not in capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    report["learned"] = [{"name": f"view{k}.png", "gains": [1.0 + k / 5, 1.0, 1.0]} for k in (0, 1)]
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert call("judge", tmp_path, "--fit-cameras", "--out", tmp_path / "judged") == 0
    aligned = report["metrics"]["mean"]["psnr_aligned"]
    told = capsys.readouterr().out
    assert f"{aligned:.2f} dB PSNR after each photo's brightness and tint are matched" in told
    assert "refined poses move points by" in told
    numbers = json.loads((tmp_path / "judged" / "judge.json").read_text())["scene"]
    assert numbers["fitted"]["mean"]["psnr"] >= numbers["mean"]["psnr"]
    assert set(numbers["fitted"]["views"]) == set(numbers["views"])


def test_info_says_that_cameras_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(make_truth(), tmp_path / "scene")
    assert call("info", tmp_path / "scene") == 0
    told = capsys.readouterr().out
    assert "poses: transforms.json" in told
    assert "are not read" not in told
    (tmp_path / "scene" / "transforms.json").rename(tmp_path / "scene" / "cameras.xml")
    assert call("info", tmp_path / "scene") == 0
    assert "cameras.xml: not read" in capsys.readouterr().out


@pytest.mark.parametrize("report", ["{}", "[1]", "{", '{"metrics": {"mean": 1, "views": [], "reasons": {}}}'])
def test_info_of_reports_that_are_none(
    report: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.json").write_text(report)
    assert call("info", tmp_path) == 2
    assert "holds no photos, no run and no scene file" in one_line(capsys)
    (tmp_path / "config.json").write_text("[1]")
    (tmp_path / "checkpoint.safetensors").touch()
    assert call("info", tmp_path) == 2
    assert "report.json is damaged" in one_line(capsys)


@pytest.mark.parametrize(
    ("config", "told"),
    [
        ('{"scene": {"path": "my photos"}}', "hqgs train 'my photos' --out {out} --resume continues it"),
        ('{"scene": null}', "hqgs.train(..., resume=True) continues it"),
        ("[1]", "hqgs.train(..., resume=True) continues it"),
    ],
)
def test_info_of_a_run_that_was_killed(
    config: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.json").write_text(config)
    (tmp_path / "checkpoint.safetensors").touch()
    assert call("info", tmp_path) == 0
    assert f"an unfinished run: {told.format(out=tmp_path)}" in capsys.readouterr().out


# --- `hqgs sfm`, `diagnose` and `info` on photos alone, as a user has them


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


# --- What the screen says of a run without a terminal: how long it takes, early and again and again


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def told(clock: list[float], step: float, count: int, length: int, every: int = 0) -> list[tuple[int, str]]:
    """The lines of so many steps of `step` seconds each, with their iterations; evaluated `every` so many."""
    screen, lines = TrainingScreen(), list[tuple[int, str]]()
    screen.live, say = False, screen.say
    for k in range(1, count + 1):
        clock[0] += step
        done = {"psnr": 20.0, "ssim": 0.5, "views": 2} if every and k % every == 0 else None
        screen.say = lambda text, k=k: (lines.append((k, text)), say(text))[0]
        now: Any = SimpleNamespace(
            iteration=k, length=length, seconds=k * step, gaussians=9, loss=0.1, evaluated=done,
            left=lambda k=k: step * (length - k),
        )  # fmt: skip
        screen(now)
    return lines


def test_fast_steps_are_estimated_after_35(clock: list[float]) -> None:
    ((iteration, text),) = told(clock, 0.05, 100, 1000)
    assert iteration == 35
    assert text.startswith("1,000 iterations; about 48 s left")


def test_slow_steps_are_estimated_after_a_few(clock: list[float]) -> None:
    iteration, text = told(clock, 2.0, 12, 30_000)[0]
    assert iteration == 4  # more than five seconds after the first
    assert "about 16.7 h left" in text


@pytest.mark.parametrize(("half", "grows"), [(0, False), (600, False), (0, True), (600, True)])
def test_what_is_left_follows_from_sizes_and_growth(half: int, grows: bool) -> None:
    """Of steps that take 1 us for each pixel and Gaussian, 1,000 px and 1,000 Gaussians, 3,000 in the end."""
    config = run_config(iterations=1000)
    config = replace(config, densify=replace(config.densify, start=70 if grows else 10**6))
    schedule = Schedule.of(RunPlan(config, 9, half_size_until=half), 5)
    stop = config.due.stop

    def step(k: int) -> float:
        count = 1000 * (1 + 2 * min(k / stop, 1)) if grows else 1000
        return 1e-6 * (count + (250 if k <= half else 1000))

    state: Any = SimpleNamespace(
        iteration=50, decisions=schedule.start(), gaussians=range(1000), recent=[step(50)] * 35
    )
    truth = sum(step(k) for k in range(51, 1001))
    assert seconds_left(schedule, state, 1000) == pytest.approx(truth, rel=0.12)


def test_a_line_each_minute_with_what_is_left(clock: list[float]) -> None:
    lines = told(clock, 1.0, 200, 1000)[1:]
    assert [iteration for iteration, _ in lines] == [68, 129, 190]
    assert lines[0][1] == "iteration 68 of 1000: 9 Gaussians, 68 s, loss 0.100; about 16 min left"


def test_evaluations_say_on_how_many_views_and_what_is_left(clock: list[float]) -> None:
    lines = told(clock, 1.0, 100, 100, every=50)[1:]
    assert lines == [
        (
            50,
            "iteration 50: 9 Gaussians, 50 s, 2 of the held-out views 20.00 dB, SSIM 0.5000; about 50 s left",
        ),
        (100, "iteration 100: 9 Gaussians, 100 s, 2 of the held-out views 20.00 dB, SSIM 0.5000"),
    ]


def test_before_the_first_step_no_silence_lasts(clock: list[float]) -> None:
    """A line every few seconds while something is done, of whatever it is; none where it is quick."""
    lines = list[tuple[float, str]]()
    screen = LoadingScreen()
    screen.live = False
    say = screen.say
    screen.say = lambda text: (lines.append((clock[0] - 100, text)), say(text))[0]
    screen.stage(Stage("COLMAP", 0, 9, "It takes long."))
    for what, step in (("photos read", 0.1), ("COLMAP: features", 2.0), ("COLMAP: matches", 0.1)):
        for k in range(1, 10):
            clock[0] += step
            screen.stage(Stage(what, k, 9))
    clock[0] += 10
    screen.stage(Stage("frames", 4, 0))
    told = [(round(when), text) for when, text in lines]
    assert told == [
        (0, "It takes long."),
        (7, "COLMAP: features: 3 of 9, about 12 s left"),
        (13, "COLMAP: features: 6 of 9, about 6 s left"),
        (19, "COLMAP: features: 9 of 9"),
        (30, "frames: 4"),
    ]
    assert screen.colmap_seconds == pytest.approx(18.9)
