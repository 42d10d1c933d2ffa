"""The benchmark `features` at tiny sizes: its JSON, what must be equal is equal, and finished runs stay."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pandas import DataFrame
from tiny_scene import tiny_config, tiny_scene

import hqgs
from benchmarks import cli, features, patches
from benchmarks.features import DEFAULT, FEATURES, PROTOCOLS
from benchmarks.patches import TorchAdam, torch_loss
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
def quick(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "features.json").read_text(encoding="utf-8"))


def test_the_file_says_where_it_comes_from(quick: dict[str, Any], folder: Path) -> None:
    assert quick["benchmark"] == "features"
    assert (
        quick["command"]
        == "python -m benchmarks features --downscale 10.0 --iterations 14 --quick --scenes embedded"
    )
    assert quick["settings"]["scenes"] == ["embedded"]
    assert quick["commit"] == quick["versions"]["git_commit"]


def test_every_feature_has_a_run_and_a_verdict(quick: dict[str, Any]) -> None:
    (scene,) = quick["results"]["scenes"]
    names = [feature.label for feature in FEATURES]
    assert [row["feature"] for row in scene["features"]] == names
    assert [row["feature"] for row in quick["results"]["verdicts"]] == names
    (default,) = scene["default"]
    for row in scene["features"]:
        (run,) = row["runs"]
        assert run["history"][-1]["iteration"] == 14
        assert run["psnr"] == run["history"][-1]["psnr"]
        assert abs(row["cost_db"]) == pytest.approx(abs(run["psnr"] - default["psnr"]))
        assert row["speedup_run"] > 0
        low, high = row["speedup_step_quartiles"]
        assert 0 < low <= row["speedup_step"] <= high
    for verdict in quick["results"]["verdicts"]:
        costs = [verdict["cost_db"], verdict["refined_cost_db"]]  # of one seed there is no error
        worst = max(cost for cost in costs if cost is not None)
        assert verdict["passed"] == (not verdict["by_default"] or worst <= 0.05)


def test_what_changes_no_bit_costs_nothing(quick: dict[str, Any]) -> None:
    (scene,) = quick["results"]["scenes"]
    rows = {row["feature"]: row for row in scene["features"]}
    for name in SAME_BITS:
        assert rows[name]["cost_db"] == 0, name
        assert rows[name]["refined_cost_db"] == 0, name
        psnr = [entry["psnr"] for entry in rows[name]["runs"][0]["history"]]
        assert psnr == [entry["psnr"] for entry in scene["default"][0]["history"]]
    for name in ("rising SH degree", "float32 rasterizer", "fused loss"):
        assert rows[name]["cost_db"] != 0, name  # the switch did something
        assert rows[name]["refined_cost_db"] != 0, name
    assert rows["rising SH degree"]["refined_cost_db"] is None  # trained harmonics have no start


def test_finished_runs_are_not_repeated(
    quick: dict[str, Any], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: Any, **options: Any) -> Any:
        raise AssertionError("trained again")

    monkeypatch.setattr(features, "train", never)
    monkeypatch.setattr(features.Features, "refined", never)
    assert call("--quick", "--iterations", "14", "--downscale", "10", "--out", folder) == 0
    again = json.loads((folder / "features.json").read_text(encoding="utf-8"))
    first, second = (r["results"]["scenes"][0] for r in (quick, again))
    assert first["default"] == second["default"]
    assert [row["runs"] for row in first["features"]] == [row["runs"] for row in second["features"]]


def test_runs_of_another_length_are_other_runs(
    folder: Path, quick: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--quick", "--iterations", "15", "--downscale", "10", "--out", folder, "--rows", "fused loss")
    assert call(*options, "--finished") == 0
    written = json.loads((folder / "features.json").read_text(encoding="utf-8"))
    assert written["results"] == {"scenes": [], "verdicts": []}
    assert [entry["what"] for entry in written["left_out"]] == [
        "run embedded, default, seed 0", "run embedded, fused loss, seed 0",
    ]  # fmt: skip


def test_a_run_that_fails_leaves_its_scene_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = features.train

    def failing(photos: Any, config: Any) -> Any:
        if config.sh_interval == 1:
            raise ValueError("it cannot")
        return real(photos, config)

    monkeypatch.setattr(features, "train", failing)
    options = ("--quick", "--iterations", "14", "--downscale", "10", "--out", tmp_path)
    assert call(*options, "--rows", "rising SH degree") == 0
    written = json.loads((tmp_path / "features.json").read_text(encoding="utf-8"))
    assert written["results"]["scenes"] == []
    assert written["left_out"] == [{"what": "run embedded, rising SH degree, seed 0", "why": "it cannot"}]


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
    assert not (tmp_path / "features.json").exists()


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


def run_of(psnr: float, seconds: float, refined: float = 31.0) -> dict[str, Any]:
    run = {"psnr": psnr, "refined_psnr": refined, "seconds": seconds, "gaussians": 1, "seed": 0}
    return run | {"history": []}


def rounds(seconds: float) -> DataFrame:
    return DataFrame({"total": [seconds] * 3})


def compare(*arguments: Any) -> list[dict[str, Any]]:
    return features.compare(FEATURES, *arguments)


def runs_of(*psnrs: float) -> dict[str, list[dict[str, Any]]]:
    runs = {f.label: [run_of(psnr, 20.0) for psnr in psnrs] for f in (DEFAULT, *FEATURES)}
    for run in runs["rising SH degree"]:
        run["refined_psnr"] = None
    return runs


def test_costs_and_verdicts_of_a_hand_made_case() -> None:
    runs = runs_of(30.06, 30.06)
    runs[DEFAULT.label] = [run_of(30.0, 10.0), run_of(30.02, 10.0)]
    steps = {name: rounds(3.0) for name in runs} | {DEFAULT.label: rounds(1.0)}
    rows = {row["feature"]: row for row in compare(runs, steps)}
    slower = rows["fused loss"]
    assert slower["costs_db"] == pytest.approx([0.06, 0.04])
    assert slower["cost_db"] == pytest.approx(0.05)
    assert (slower["speedup_run"], slower["speedup_step"]) == (2, 3)
    assert rows["rising SH degree"]["refined_costs_db"] == []
    runs["fused Adam"] = [run_of(30.2, 20.0), run_of(30.2, 20.0)]
    found = {row["feature"]: row for row in features.verdicts([{"features": compare(runs, steps)}] * 2)}
    assert found["fused Adam"]["cost_db"] == pytest.approx(0.19)
    assert not found["fused Adam"]["passed"]
    spread = np.std([0.2, 0.18, 0.2, 0.18], ddof=1) / math.sqrt(4)
    assert found["fused Adam"]["standard_error_db"] == pytest.approx(spread)


def test_whole_runs_must_be_sure_to_cost_too_much_and_the_refined_ones_only_do() -> None:
    def passes(other: list[dict[str, Any]]) -> bool:
        runs = runs_of(30.0, 30.0)
        runs["fused loss"] = other
        steps = {name: rounds(1.0) for name in runs}
        found = {row["feature"]: row for row in features.verdicts([{"features": compare(runs, steps)}])}
        return found["fused loss"]["passed"]

    assert passes([run_of(30.5, 10.0), run_of(29.9, 10.0)])  # 0.2 dB with an error of 0.3
    assert not passes([run_of(30.2, 10.0), run_of(30.21, 10.0)])
    assert not passes([run_of(30.0, 10.0, 31.1), run_of(30.0, 10.0, 31.02)])
