"""Several views in a step, and several processes: the same bits for any number of them, and clear ends."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_method import Tinted, install
from forks import forks
from planned import schedule_of
from run_state import assert_same, read_state, run_until
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.base import ranks as module
from hqgs.base.files import CHECKPOINT, PLY
from hqgs.base.ranks import ALONE, RankError, joined
from hqgs.cli.main import main
from hqgs.training.adam import Adam
from hqgs.training.batch import Part, give_harmonics, give_others, part_of, to_rasterize
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.forward import TrainingViews
from hqgs.training.guard import MAX_SKIPPED_IN_A_ROW, Fault
from hqgs.training.methods.base import ThreeDGS
from hqgs.training.trainer import Trainer

ROOT = Path(__file__).parents[1]
STILL = DensifyConfig(start=10_000, reset_every=10_000)
CASES: dict[str, dict[str, Any]] = {
    "3dgs": {"leave_out": ("growth",)},
    "tinted": {"method": "tinted"},  # a tensor of its own, and harmonics of which all is sent
    "hqgs": {"method": "hqgs", "hqgs": hqgs.TrainConfig().hqgs.__class__(formation="exposure")},
}


def config_of(case: str, batch: int = 4) -> TrainConfig:
    """Growth, a reset and all degrees within 40 views."""
    return tiny_config(40, batch=batch, **CASES[case])


def started(count: int, out: Path, what: str) -> list[tuple[ForkServerProcess, Path]]:
    """`work` in `count` processes, and where each writes what it says."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(count)}
    processes = []
    for rank in range(count):
        told = out / f"rank {rank}.txt"
        process = forks().Process(target=_work, args=({**own, "RANK": str(rank)}, told, str(out), what))
        process.start()
        processes.append((process, told))
    return processes


def ended(processes: list[tuple[ForkServerProcess, Path]]) -> list[tuple[int | None, str]]:
    """Exit codes and what was said."""
    for process, _ in processes:
        process.join(240)
    return [(process.exitcode, told.read_text()) for process, told in processes]


def _work(environment: dict[str, str], told: Path, out: str, what: str) -> None:
    os.environ.update(environment)
    with told.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    work(out, what)


def work(out: str, what: str) -> None:
    """What each process does: `what` is a list of cases, or a case and how a rank ends in it."""
    monkeypatch = pytest.MonkeyPatch()
    install(monkeypatch, "tinted", lambda *given: Tinted())
    names, _, fault = what.partition(":")
    module.PIECE = 20_000  # the longest messages have several
    if fault == "bad":
        module.HEARTBEAT = 0.5
    with joined() as ranks:
        for case in names.split(","):
            for threads in (1, 2) if ranks.count == 1 else (2,):
                hqgs.set_num_threads(threads)

                def show(now: hqgs.Progress) -> None:
                    if fault and now.iteration >= 21 and ranks.rank == 1:
                        if fault == "bad":
                            raise ValueError("photo x.png is broken")
                        os.kill(os.getpid(), signal.SIGKILL)

                folder = Path(out, case, str(threads))
                run = hqgs.train(
                    tiny_scene(9), out=folder, config=config_of(case), resume=True, progress=show, ranks=ranks
                )
                assert run.finished
                assert len(run.report["ranks"]) == (ranks.count if ranks.count > 1 else 0)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one process comes to, of each case."""
    out = tmp_path_factory.mktemp("alone")
    work(str(out), ",".join(CASES))
    return out


@pytest.mark.parametrize("count", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_same_bits_for_any_number_of_processes_and_threads(count: int, alone: Path, tmp_path: Path) -> None:
    for code, said in ended(started(count, tmp_path, ",".join(CASES))):
        assert code == 0, said
    for case in CASES:
        expected = read_state(alone / case / "1" / CHECKPOINT)
        for folder in (alone / case / "2", tmp_path / case / "2"):
            assert_same(read_state(folder / CHECKPOINT), expected)
            assert (folder / PLY).read_bytes() == (alone / case / "1" / PLY).read_bytes()


def test_a_killed_rank_ends_the_others_and_another_number_goes_on(alone: Path, tmp_path: Path) -> None:
    began = time.perf_counter()
    first, killed = ended(started(2, tmp_path, "3dgs:killed"))
    assert killed[0] == -signal.SIGKILL
    assert first[0] == 1
    assert "RankError: rank 1 has gone: it was stopped, or its machine was cut off" in first[1]
    assert time.perf_counter() - began < 60
    folder = tmp_path / "3dgs" / "2"
    assert not (folder / PLY).exists()
    assert 0 < read_state(folder / CHECKPOINT)[1]["iteration"] < 40  # type: ignore[operator]
    work(str(tmp_path), "3dgs")
    assert_same(read_state(folder / CHECKPOINT), read_state(alone / "3dgs" / "1" / CHECKPOINT))
    assert (folder / PLY).read_bytes() == (alone / "3dgs" / "1" / PLY).read_bytes()


def test_what_fails_on_one_rank_is_told_by_all(tmp_path: Path) -> None:
    first, second = ended(started(2, tmp_path, "3dgs:bad"))
    assert "RankError: rank 1 failed: photo x.png is broken" in first[1]
    assert "ValueError: photo x.png is broken" in second[1]
    assert first[0] == second[0] == 1


def test_torchrun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command as users give it; one process comes to the same scene, and a restart goes on."""
    arguments = ["embedded", "--downscale", "16", "--iterations", "12", "--batch", "3", "--method", "3dgs"]
    train = ["-m", "hqgs", "train", *arguments, "--out", str(tmp_path / "two")]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    done = subprocess.run([*torchrun, *train], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("measuring the photos") == 1
    assert main(["train", *arguments, "--out", str(tmp_path / "one")]) == 0
    assert (tmp_path / "one" / PLY).read_bytes() == (tmp_path / "two" / PLY).read_bytes()
    capsys.readouterr()


def test_a_restart_implies_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["train", "embedded", "--downscale", "16", "--iterations", "6", "--method", "3dgs"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "1")
    assert main([*arguments, "--out", str(tmp_path), "--overwrite"]) == 0


def test_torchrun_must_have_set_all_that_it_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("RANK", raising=False)
    with pytest.raises(ValueError, match="RANK is not set: start several processes with torchrun"), joined():
        pass


# --- a step of several views ---


def test_gradients_are_those_of_the_mean_of_the_losses() -> None:
    scene, config = tiny_scene(), config_of("3dgs")
    trainer = run_until(Trainer(scene, config), 6)
    gaussians, optimizer = trainer.gaussians, trainer.state.optimizer
    plans = trainer.schedule.batch(26, trainer.state.decisions)
    assert len(plans) == 4
    assert plans[0].degree == 3
    training = TrainingViews(scene.train, ThreeDGS(), config.background)
    parts = list[Part]()
    for plan in plans:
        forward = training.at(plan, to_rasterize(gaussians, gaussians), 0)
        assert forward.backward(trainer.state) is None
        assert gaussians.shN.grad is None  # it is made of sh0's
        part = part_of(forward, None, gaussians, optimizer)
        # Its number, a colour, all others, and what growth goes by.
        assert len(part.packed()) == pytest.approx(4 * (1 + 3 + 3 + 3 + 4 + 1 + 1) * len(part.rows), abs=800)
        parts.append(Part.unpacked(part.packed()))
    optimizer.zero_grad()
    give_harmonics(parts, gaussians, gaussians)
    assert set(give_others(parts, gaussians, optimizer).values()) == {4}
    ours = {name: tensor.grad for name, tensor in gaussians.named().items()}
    optimizer.zero_grad()
    torch.stack([training.at(plan, gaussians, 0).loss for plan in plans]).mean().backward()
    for name, tensor in gaussians.named().items():
        expected, got = tensor.grad, ours[name]
        assert expected is not None
        assert got is not None
        assert expected.abs().max() > 0
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=2e-6 * float(expected.abs().max()))


def test_a_part_comes_back_with_the_same_bits() -> None:
    rows = torch.tensor([True, False, True])
    part = Part(
        loss=0.1 + 0.2,
        degree=2,
        measured=torch.tensor([math.pi], dtype=torch.float64),
        fault=Fault("gradient", ["means", "sh0"], rows, 3),
        center=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64),
        rows=torch.tensor([1, 5], dtype=torch.int32),
        colors=torch.tensor([[1e-40, -0.0, 1.0], [3.0, 4.0, 5.0]]),
        values=torch.tensor([[1e-40, -0.0]]),
        own={"paths.3": torch.ones(2, 6, dtype=torch.float64)},
    )
    back = Part.unpacked(part.packed())
    assert (back.loss, back.degree) == (part.loss, 2)
    assert back.fault is not None
    assert (back.fault.what, back.fault.tensors, back.fault.values) == ("gradient", ["means", "sh0"], 3)
    assert torch.equal(back.fault.rows, rows)
    names = ("measured", "center", "rows", "colors", "values")
    for there, here in [
        *((getattr(back, name), getattr(part, name)) for name in names),
        (back.own["paths.3"], part.own["paths.3"]),
    ]:
        assert there.dtype == here.dtype
        assert there.numpy().tobytes() == here.numpy().tobytes()
    assert back.higher is None


def test_steps_take_each_view_of_the_schedule_once() -> None:
    config = replace(config_of("3dgs", batch=3), leave_out=())
    views = tiny_scene(9).train
    schedule = schedule_of(config, views)
    decisions, steps, done = schedule.start(), [], 0
    while done < config.iterations:
        plans = schedule.batch(done + 1, decisions)
        assert [plan.iteration for plan in plans] == list(range(done + 1, done + 1 + len(plans)))
        assert len({plan.view for plan in plans}) == len(plans) <= 3
        assert not any(plan.resets for plan in plans[1:])
        assert not any(plan.densifies for plan in plans[:-1])
        done = plans[-1].iteration
        steps.append(plans)
    assert done == config.iterations
    sizes = [len(plans) for plans in steps]
    assert max(sizes) == 3
    assert np.mean(sizes) > 2.2
    one = schedule_of(replace(config, batch=1), views)
    alone = [one.batch(k, decisions) for k in range(1, 41)]
    assert [plans[0] for plans in alone] == [plan for plans in steps for plan in plans]
    assert {len(plans) for plans in alone} == {1}


def test_rates_and_moments_follow_the_number_of_views() -> None:
    params = [torch.linspace(-1, 1, 30).requires_grad_() for _ in range(2)]
    ours = Adam([params[0]], lr=0.01, eps=1e-15)
    theirs = torch.optim.Adam([params[1]], lr=0.02, betas=(0.9**4, 0.999**4), eps=1e-15)
    for _ in range(5):
        for param in params:
            param.grad = (param.detach() - 0.3) ** 3
        ours.step(views={params[0]: 4})
        theirs.step()
    np.testing.assert_allclose(params[0].detach(), params[1].detach(), rtol=1e-6)


def spoil_next(trainer: Trainer, row: int) -> None:
    """The next gradient of this Gaussian is not finite."""
    trained = trainer.gaussians.opacities

    def spoiled(gradient: torch.Tensor) -> torch.Tensor:
        hook.remove()
        return gradient.index_fill(0, torch.tensor([row]), math.nan)

    hook = trained.register_hook(spoiled)


def test_bad_photos_and_gradients_leave_their_view_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other views of the step are trained; where a Gaussian is at fault, none of them."""
    trainer = Trainer(tiny_scene(9), replace(config_of("3dgs"), densify=STILL))
    loss, names = trainer.method.loss, []

    def spoiled(image: torch.Tensor, target: Any) -> torch.Tensor:
        names.append(target)
        return loss(image, target) * (math.nan if len(names) == 2 else 1.0)

    monkeypatch.setattr(trainer.method, "loss", spoiled)
    before = trainer.gaussians.means.detach().clone()
    trainer.step()
    assert (trainer.state.guard.skipped, trainer.state.guard.skipped_in_a_row) == (1, 0)
    assert trainer.state.guard.events[0]["what"] == "loss"
    assert not torch.equal(trainer.gaussians.means.detach(), before)
    spoil_next(trainer, 3)
    before = trainer.gaussians.sh0.detach().clone()
    trainer.step()
    assert torch.equal(trainer.gaussians.sh0.detach(), torch.cat([before[:3], before[4:]]))
    assert (trainer.state.guard.skipped, trainer.state.guard.culled) == (1 + 4, 1)


def test_a_bad_gaussian_ends_no_run_of_large_steps() -> None:
    batch = MAX_SKIPPED_IN_A_ROW + 4
    trainer = Trainer(tiny_scene(batch + 2), replace(config_of("3dgs", batch), densify=STILL))
    spoil_next(trainer, 3)
    trainer.step()
    assert (trainer.state.guard.skipped, trainer.state.guard.skipped_in_a_row) == (batch, 1)


def test_a_batch_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="batch is 0, wanted at least 1"):
        hqgs.train(tiny_scene(), batch=0)


def test_one_process_is_a_rank_too() -> None:
    assert ALONE.divide(range(3), lambda k: k * k) == [0, 1, 4]
    assert ALONE.tell({"a": 1}) == [{"a": 1}]
    assert ALONE.begin(b"x")() == [b"x"]
    with joined() as ranks:
        assert ranks is ALONE
    assert issubclass(RankError, RuntimeError)
