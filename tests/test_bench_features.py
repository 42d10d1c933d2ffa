"""The benchmark `features` at tiny sizes: its lines, what must be equal is equal, and finished runs stay."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_scene import tiny_config, tiny_scene

import hqgs
from benchmarks import cli, features, patches
from benchmarks.features import DEFAULT, FEATURES, PROTOCOLS
from benchmarks.patches import TorchAdam, torch_loss
from benchmarks.rows import Table
from benchmarks.speed.training import still_trainer
from hqgs.training.methods.photometric import photometric_loss
from hqgs.training.trainer import Trainer

SAME_BITS = ("exact spans of tiles", "skipping of blocks", "all threads")


def call(*arguments: str | Path) -> int:
    return cli.main(["features", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a quick run of 14 iterations."""
    out = tmp_path_factory.mktemp("bench")
    before = hqgs.get_num_threads()
    hqgs.set_num_threads(2)
    try:
        assert call("--quick", "--iterations", "14", "--downscale", "10", "--out", out) == 0
        assert hqgs.get_num_threads() == 2
    finally:
        hqgs.set_num_threads(before)
    return out


@pytest.fixture(scope="module")
def quick(folder: Path) -> dict[str, dict[str, Any]]:
    """The lines by feature."""
    return {str(line["row"]): line for line in Table(folder / "features.csv").frame().to_dict("records")}


def test_every_feature_has_a_run_and_a_timed_step(quick: dict[str, Any]) -> None:
    assert list(quick) == [DEFAULT.label, *(feature.label for feature in FEATURES)]
    for feature in FEATURES:
        line = quick[feature.label]
        assert line["iterations"] == 14
        assert line["psnr"] > 5
        assert 0 < line["step_low"] <= line["step_ratio"] <= line["step_high"]


def test_what_changes_no_bit_costs_nothing(quick: dict[str, Any]) -> None:
    default = quick[DEFAULT.label]
    for name in SAME_BITS:
        assert quick[name]["psnr"] == default["psnr"], name
        assert quick[name]["refined_psnr"] == default["refined_psnr"], name
    assert quick["rising SH degree"]["psnr"] != default["psnr"]  # the switch did something
    assert math.isnan(quick["rising SH degree"]["refined_psnr"])  # trained harmonics have no start


def test_finished_runs_are_not_repeated(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args: Any, **options: Any) -> Any:
        raise AssertionError("done again")

    monkeypatch.setattr(features, "train", never)
    for name in ("refined", "final_steps"):
        monkeypatch.setattr(features.Features, name, never)
    before = (folder / "features.csv").read_bytes()
    assert call("--quick", "--iterations", "14", "--downscale", "10", "--out", folder) == 0
    assert (folder / "features.csv").read_bytes() == before


def test_runs_of_another_length_are_other_runs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--quick", "--iterations", "15", "--downscale", "10", "--out", folder, "--rows", "fused loss")
    assert call(*options, "--finished") == 0
    assert capsys.readouterr().out.splitlines()[::2] == [
        "left out: run embedded, default, seed 0: not finished",
        "left out: run embedded, fused loss, seed 0: not finished",
    ]


def test_a_run_that_fails_leaves_its_steps_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = features.train

    def failing(photos: Any, config: Any) -> Any:
        if getattr(*patches.LOSS) is torch_loss:
            raise ValueError("it cannot")
        return real(photos, config)

    monkeypatch.setattr(features, "train", failing)
    options = ("--quick", "--iterations", "3", "--downscale", "10", "--out", tmp_path)
    assert call(*options, "--rows", "fused loss") == 0
    assert "left out: run embedded, fused loss, seed 0: it cannot" in capsys.readouterr().out
    assert [line["row"] for line in Table(tmp_path / "features.csv").rows()] == ["default"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--iterations", "0"], "iterations is 0, wanted at least 1"),
        (["--seeds", "-1"], "seed is -1, wanted at least 0"),
        (["--repeats", "0"], "repeats is 0, wanted at least 1"),
        (["--downscale", "0.5"], "downscale must be at least 1, got 0.5"),
        (["--scenes", "/no/such/folder"], "there is no scene folder /no/such/folder"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert call("--quick", "--out", tmp_path, *arguments) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "features.csv").exists()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(24, 31, 3), (5, 6, 3)])
def test_the_loss_in_torch_is_the_loss(masked: bool, shape: tuple[int, int, int]) -> None:
    g = torch.Generator().manual_seed(2)
    render = torch.rand(shape, dtype=torch.float64, generator=g).requires_grad_()
    target = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
    mask = torch.rand(shape[:2], generator=g) > 0.3 if masked else None
    found = []
    for loss in (torch_loss, photometric_loss):
        value = loss(render, target, mask)
        (grad,) = torch.autograd.grad(value, render)
        found.append((value.detach(), grad))
    assert torch.allclose(found[0][0], found[1][0], rtol=0, atol=1e-12)
    assert torch.allclose(found[0][1], found[1][1], rtol=0, atol=1e-12)


def test_switches_are_undone() -> None:
    before = hqgs.get_num_threads(), torch.get_num_threads()
    watched = patches.PROJECT, patches.RASTERIZATION, patches.ADAM, patches.ONE_TORCH_THREAD, patches.LOSS
    found = [getattr(*place) for place in watched]
    default = PROTOCOLS["quick"].train_config(DEFAULT, 0)
    changed: set[str] = set()
    for feature in FEATURES:
        with feature.switched():
            inside = [getattr(*place) for place in watched]
            if hqgs.get_num_threads() == 1 < before[0] or inside != found:
                changed.add(feature.label)
        assert [getattr(*place) for place in watched] == found
        assert (hqgs.get_num_threads(), torch.get_num_threads()) == before
        if PROTOCOLS["quick"].train_config(feature, 0) != default:
            changed.add(feature.label)
    expected = {f.label for f in FEATURES} - ({"all threads"} if before[0] == 1 else set())
    assert changed == expected


def test_a_trainer_with_adam_of_torch_learns_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = Trainer(tiny_scene(), tiny_config())
    monkeypatch.setattr(*patches.ADAM, TorchAdam)
    theirs = Trainer(tiny_scene(), tiny_config())
    assert isinstance(theirs.state.optimizer, torch.optim.Adam)
    for _ in range(7):  # before the number of Gaussians can differ
        ours.step()
        theirs.step()
    for name, tensor in ours.gaussians.named().items():
        assert torch.allclose(tensor, theirs.gaussians.named()[name], atol=1e-4), name


def test_a_trainer_with_the_loss_in_torch_learns_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """To other bits, which tables may round away."""
    ours = Trainer(tiny_scene(), tiny_config())
    for _ in range(7):
        ours.step()
    monkeypatch.setattr(*patches.LOSS, torch_loss)
    theirs = Trainer(tiny_scene(), tiny_config())
    for _ in range(7):
        theirs.step()
    found = theirs.gaussians.named()
    assert torch.allclose(ours.gaussians.means, found["means"], atol=1e-4)
    assert any(not torch.equal(tensor, found[name]) for name, tensor in ours.gaussians.named().items())


def test_the_final_scene_stays_what_it_is_while_it_is_timed() -> None:
    trained = Trainer(tiny_scene(), tiny_config())
    for _ in range(20):
        trained.step()
    final = trained.gaussians.detached()
    still = still_trainer(tiny_scene(), tiny_config(), final)
    for _ in range(5):
        still.step()
    assert len(still.gaussians) == len(final)
    for name, tensor in still.gaussians.named().items():
        assert torch.allclose(tensor, final.named()[name], atol=1e-4), name
