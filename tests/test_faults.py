"""Faults of the machine: kill -9, a full disk, a read-only folder, lost photos, a clock that jumps.

After each of them a run can be resumed or says in one line what is wrong, and nothing finished is lost.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures_scenes import make_truth, write_colmap
from forks import forks
from PIL import Image
from run_state import State, assert_same, read_state
from tiny_scene import tiny_config, tiny_scene

from benchmarks import cli as benchmarks
from benchmarks.command import Benchmark
from hqgs.base.files import CHECKPOINT, PLY, FolderBusyError, write_json
from hqgs.cli import main as cli
from hqgs.model.gaussians import Gaussians
from hqgs.pipeline import train
from hqgs.scene.formats.colmap import write_colmap as write_model
from hqgs.scene.load import load_scene
from hqgs.training.checkpoint import load_checkpoint, save_checkpoint
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.trainer import Trainer

NOBODY = 65534  # the user id without rights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A COLMAP scene of 9 photos, 48 x 36, with 12 points."""
    return write_colmap(make_truth(), tmp_path_factory.mktemp("scene"))


def call(*arguments: str | Path) -> int:
    return cli.main([str(argument) for argument in arguments])


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The last line on stderr; there is no traceback before it."""
    err = capsys.readouterr().err
    assert "Traceback" not in err
    return err.splitlines()[-1]


def hidden(path: Path) -> list[str]:
    """Temporary files below a folder."""
    return [p.name for p in path.rglob(".*") if p.name != ".lock"]


# --- runs that are killed


def _train_in_child(out: Path, config: TrainConfig) -> None:
    train(tiny_scene(), config=config, out=out, resume=True)


def _command_in_child(arguments: list[str], stderr: Path, user: int | None) -> None:
    with stderr.open("w") as sys.stderr:
        if user is not None:
            os.setuid(user)
        command, *rest = arguments
        code = benchmarks.main(rest) if command == "benchmarks" else cli.main(arguments)
        sys.stderr.flush()
    os._exit(code)


@pytest.fixture(scope="module")
def processes() -> ForkServerContext:
    return forks()


def start(processes: ForkServerContext, out: Path, config: TrainConfig) -> ForkServerProcess:
    child = processes.Process(target=_train_in_child, args=(out, config))
    child.start()
    return child


def wait_for(path: Path, child: ForkServerProcess) -> None:
    end = time.monotonic() + 60
    while not path.exists():
        assert child.is_alive() or path.exists(), f"the child ended with {child.exitcode}"
        assert time.monotonic() < end
        time.sleep(0.01)


def check_files(out: Path) -> None:
    """Every file that has its final name is whole."""
    if (out / CHECKPOINT).exists():
        load_checkpoint(out / CHECKPOINT)
    if (out / PLY).exists():
        assert len(Gaussians.load(out / PLY)) > 0
    if (out / "report.json").exists():
        report = json.loads((out / "report.json").read_text())
        for name in (v["picture"] for v in report["metrics"]["views"]):
            with Image.open(out / name) as picture:
                picture.load()


@pytest.fixture(scope="module")
def undisturbed(
    processes: ForkServerContext, tmp_path_factory: pytest.TempPathFactory
) -> tuple[State, bytes]:
    """State and PLY of a whole run of 30 iterations; growth and resets are among them."""
    out = tmp_path_factory.mktemp("undisturbed")
    child = start(processes, out, replace(tiny_config(), checkpoint_every=1))
    child.join()
    assert child.exitcode == 0
    return read_state(out / CHECKPOINT), (out / PLY).read_bytes()


def wait_for_writes(path: Path, count: int, child: ForkServerProcess) -> None:
    """Until so many new versions of a file have been seen, or the child has ended."""
    seen, last = 0, None
    while seen < count and child.is_alive():
        with suppress(FileNotFoundError):
            now = path.stat()
            if (version := (now.st_ino, now.st_mtime_ns)) != last:
                seen, last = seen + 1, version
        time.sleep(0.001)


@pytest.mark.parametrize("count", [4, pytest.param(50, marks=pytest.mark.slow)])
def test_runs_killed_at_random_moments_can_be_resumed(
    count: int, undisturbed: tuple[State, bytes], processes: ForkServerContext, tmp_path: Path
) -> None:
    """Moments count in iterations, so that they spread over the run on any machine."""
    state, ply = undisturbed
    rng = np.random.default_rng(11)
    config = replace(tiny_config(), checkpoint_every=1)  # as many chances as there can be to hit a write
    kills = 0
    for k in range(count):
        out = tmp_path / str(k)
        writes = round(k / count * 24)  # of 30; the first one is killed before or at its first write
        child = start(processes, out, config)
        wait_for_writes(out / CHECKPOINT, writes, child)
        time.sleep(rng.uniform(0.0, 0.05))
        child.kill()
        child.join()
        kills += child.exitcode == -signal.SIGKILL
        assert (out / CHECKPOINT).exists() or writes == 0
        check_files(out)
        result = train(tiny_scene(), config=config, out=out, resume=True)
        assert result.iterations == 30
        assert_same(read_state(out / CHECKPOINT), state)
        assert (out / PLY).read_bytes() == ply
        check_files(out)
        assert hidden(out) == []
    assert kills >= count // 3  # a slow observer may come too late for some


def test_what_a_killed_writer_leaves_is_removed(tmp_path: Path) -> None:
    """Also the file that safetensors itself makes: a kill at that moment is too rare to wait for."""
    train(tiny_scene(), config=tiny_config(3), out=tmp_path)
    names = [".tmpAb3dE9", f".{Path(PLY).stem}.x{Path(PLY).suffix}"]
    for name in names:
        (tmp_path / name).write_bytes(b"half")
    assert set(hidden(tmp_path)) >= set(names)
    train(tiny_scene(), config=tiny_config(3), out=tmp_path, resume=True)
    assert hidden(tmp_path) == []


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_a_real_ctrl_c_is_exit_code_130_with_checkpoint_and_report(
    processes: ForkServerContext, folder: Path, tmp_path: Path, ending: signal.Signals
) -> None:
    out = tmp_path / "out"
    command = ["train", str(folder), "--out", str(out), "--iterations", "50000", "--eval-every", "50000"]
    child = processes.Process(target=_command_in_child, args=(command, tmp_path / "stderr", None))
    child.start()
    wait_for(out / CHECKPOINT, child)
    assert child.pid is not None
    os.kill(child.pid, ending)
    child.join(60)
    assert child.exitcode == 130
    done = json.loads((out / "report.json").read_text())["iterations"]
    assert 1 <= done < 50_000
    assert load_checkpoint(out / CHECKPOINT)[1]["iteration"] == done


def test_a_second_run_in_the_folder_is_refused_until_the_first_ends(
    processes: ForkServerContext, tmp_path: Path
) -> None:
    child = start(processes, tmp_path, tiny_config(100_000, densify=DensifyConfig(stop=0)))
    wait_for(tmp_path / CHECKPOINT, child)
    with pytest.raises(FolderBusyError, match=f"another run is writing into {tmp_path}"):
        train(tiny_scene(), config=tiny_config(), out=tmp_path, resume=True)
    child.kill()
    child.join()
    assert (tmp_path / ".lock").exists()  # which holds nobody up
    assert train(tiny_scene(), config=tiny_config(), out=tmp_path, overwrite=True).iterations == 30


# --- a full disk


@contextmanager
def small_files(limit: int) -> Iterator[None]:
    """Writing beyond `limit` bytes of a file fails nearly as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 320 KiB, where the system lets us have one."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=320k", "tmpfs", str(path)]
    if os.geteuid() != 0 or not shutil.which("mount"):
        pytest.skip("needs root for a small disk")
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        yield path
    finally:
        subprocess.run(["umount", str(path)], check=True)


def fill(disk: Path, left: int) -> None:
    """Leave so many bytes on a disk."""
    (disk / "filler").unlink(missing_ok=True)
    state = os.statvfs(disk)
    (disk / "filler").write_bytes(bytes(max(state.f_bavail * state.f_frsize - left, 0)))


@pytest.mark.parametrize("limit", [2_000, 40_000])  # too small for the checkpoint; for the report's chart
def test_a_limit_on_files_is_exit_code_1_and_names_the_folder(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], limit: int
) -> None:
    out = tmp_path / "out"
    with small_files(limit):
        code = call("train", folder, "--out", out, "--iterations", "20", "--max-gaussians", "40")
    assert code == 1
    assert (out / CHECKPOINT).exists() == (limit > 30_000)
    line = last_line(capsys)
    assert line.startswith(f"hqgs: {out}: ")
    assert "File too large" in line
    assert hidden(out) == []


def test_a_full_disk_leaves_the_older_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, {"a": torch.zeros(4)}, {"iteration": 1})
    with small_files(50_000), pytest.raises(OSError, match=r"cannot write the checkpoint .*a\.safetensors: "):
        save_checkpoint(path, {"a": torch.zeros(40_000)}, {"iteration": 2})
    assert load_checkpoint(path)[1] == {"iteration": 1}
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_run_on_a_full_disk_goes_on_once_there_is_room(
    folder: Path, disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = disk / "out"
    command = ["train", folder, "--out", out, "--iterations", "20", "--max-gaussians", "40"]
    fill(disk, 100_000)  # cameras and photos, and a checkpoint, not the next one beside it
    assert call(*command) == 1
    line = last_line(capsys)
    assert line.startswith(f"hqgs: {out}: ")
    assert "No space left on device" in line
    assert hidden(out) == []
    before = load_checkpoint(out / CHECKPOINT)[1]["iteration"]
    assert before >= 2
    (disk / "filler").unlink()
    fill(disk, 4_096)
    assert call(*command, "--resume") == 1
    assert "No space left on device" in last_line(capsys)
    assert load_checkpoint(out / CHECKPOINT)[1]["iteration"] == before
    (disk / "filler").unlink()
    assert call(*command, "--resume") == 0
    assert json.loads((out / "report.json").read_text())["iterations"] == 20


def test_every_writer_leaves_the_old_file_on_a_full_disk(disk: Path) -> None:
    trainer = Trainer(tiny_scene(), tiny_config())
    writers = {
        "a.json": lambda path: write_json(path, {"a": "x" * 9_000}),
        "a.ply": lambda path: trainer.gaussians.save(path),
        "a.safetensors": trainer.save,
    }
    for name in writers:
        (disk / name).write_bytes(b"old")
    fill(disk, 0)
    for name, write in writers.items():
        with pytest.raises(OSError, match="No space left"):
            write(disk / name)
        assert (disk / name).read_bytes() == b"old"
    assert hidden(disk) == []


def test_a_model_that_did_not_fit_is_noticed(disk: Path) -> None:
    """COLMAP's own writer says nothing when the disk is full."""
    scene = tiny_scene()
    cameras = {view.name: view.camera for view in scene.train}
    points = np.ones((5_000, 3), np.float32)
    fill(disk, 60_000)
    with pytest.raises(OSError, match=r"cannot write the COLMAP model .*points3D.bin is damaged"):
        write_model(disk / "a", cameras, points, np.zeros((5_000, 3), np.uint8))
    fill(disk, 0)
    with pytest.raises(OSError, match=r"No space left|cannot write the COLMAP model"):
        write_model(disk / "b", cameras, points[:9], np.zeros((9, 3), np.uint8))


def test_degrade_on_a_full_disk_leaves_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with small_files(300):
        assert call("degrade", folder, "--kind", "noise:9", "--out", tmp_path / "out") == 1
    assert last_line(capsys).startswith(f"hqgs: {tmp_path / 'out'}: ")
    assert list(tmp_path.iterdir()) == []


def test_degrade_on_a_small_disk_leaves_nothing(
    folder: Path, disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["degrade", folder, "--kind", "noise:9", "--out", disk / "out"]
    for left in (4_096, 30_000, 50_000):
        fill(disk, left)
        assert call(*command) == 1, left
        assert "No space left on device" in last_line(capsys)
        assert [p.name for p in disk.iterdir()] == ["filler"]
        (disk / "filler").unlink()
    assert call(*command) == 0
    assert len(load_scene(disk / "out").train) == 7


def test_a_benchmark_on_a_full_disk_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(args: Any) -> list[str]:
        write_json(args.out / "run.json", "x" * 9_000)
        return []

    monkeypatch.setitem(benchmarks.BENCHMARKS, "stability", Benchmark("full", full))
    with small_files(4_000):
        assert benchmarks.main(["stability", "--quick", "--out", str(tmp_path)]) == 1
    assert last_line(capsys) == f"hqgs: {tmp_path}: [Errno 27] File too large"
    assert list(tmp_path.iterdir()) == []


# --- folders, photos, clocks


def test_a_folder_that_cannot_be_written_is_bad_input(processes: ForkServerContext, folder: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        root.chmod(0o755)
        shutil.copytree(folder, root / "scene")
        (root / "scene").chmod(0o755)
        (root / "out").mkdir()
        (root / "out").chmod(0o555)
        user = NOBODY if os.geteuid() == 0 else None
        scene, out, stderr = str(root / "scene"), str(root / "out"), root / "stderr"
        for command in (
            ["train", scene, "--out", out, "--iterations", "5"],
            ["train", scene, "--out", f"{out}/deep/er", "--iterations", "5"],
            ["degrade", scene, "--kind", "none", "--out", f"{out}/scene"],
            ["diagnose", scene, "--out", f"{out}/a.json"],
            ["benchmarks", "stability", "--quick", "--out", f"{out}/bench"],
        ):
            child = processes.Process(target=_command_in_child, args=(command, stderr, user))
            child.start()
            child.join(60)
            assert child.exitcode == 2, (command, stderr.read_text())
            lines = stderr.read_text().splitlines()
            assert len(lines) == 1, lines
            assert "no permission" in lines[0]
            assert out in lines[0]
            stderr.unlink()
        assert list((root / "out").iterdir()) == []


def test_a_photo_that_is_gone_or_changed_is_named_and_the_run_is_kept(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out = tmp_path / "scene", tmp_path / "out"
    shutil.copytree(folder, scene)
    command = ["train", scene, "--out", out, "--iterations", "6", "--max-gaussians", "40"]
    assert call(*command) == 0
    checkpoint = (out / CHECKPOINT).read_bytes()
    photo = scene / "images" / "view_03.png"
    content = photo.read_bytes()
    photo.unlink()
    capsys.readouterr()
    assert call(*command, "--resume") == 2
    said = capsys.readouterr()
    assert "view_03.png" in said.out + said.err
    assert "is of another scene: its photos had other names" in said.err
    shutil.copy(scene / "images" / "view_04.png", photo)
    assert call(*command, "--resume") == 2
    assert "is of another scene: its photos had other pixels (--degrade" in last_line(capsys)
    assert (out / CHECKPOINT).read_bytes() == checkpoint
    photo.write_bytes(content)
    assert call(*command, "--resume") == 0


def test_a_photo_that_goes_while_it_is_trained_on_is_not_missed(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "scene")
    scene = load_scene(tmp_path / "scene")
    trainer = Trainer(scene, tiny_config())
    shutil.rmtree(tmp_path / "scene")
    for _ in range(9):
        trainer.step()
    trainer.evaluate()
    trainer.save(tmp_path / CHECKPOINT)
    assert trainer.state.guard.num_events == 0


def test_a_clock_that_goes_backwards_gives_no_negative_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [2e9]

    def backwards() -> float:
        now[0] -= 3600.0
        return now[0]

    monkeypatch.setattr(time, "time", backwards)
    monkeypatch.setattr(time, "time_ns", lambda: int(backwards() * 1e9))
    train(tiny_scene(), config=tiny_config(), out=tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    seconds = [0.0, *(entry["seconds"] for entry in report["history"]), report["seconds"]]
    assert seconds == sorted(seconds)
    assert 0 < seconds[-1] < 3600
