"""Configurations in files, of another length, and from the command line."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from planned import run_config
from tiny_scene import tiny_config, tiny_scene

from hqgs.base.files import CHECKPOINT, CONFIG
from hqgs.cli.main import COMMANDS, main
from hqgs.cli.train import Train, asked_for, loading, read
from hqgs.evaluation.verdict import verdict
from hqgs.pipeline import train
from hqgs.scene.options import LoadOptions
from hqgs.training.config import (
    PRESETS,
    TrainConfig,
    config_values,
    decided,
    read_said,
    said_by,
    with_iterations,
)


def options(*arguments: str | Path) -> Train:
    return read(Train, "train", "train", ["photos", "--out", "nowhere", *map(str, arguments)])


def config_of(options: Train) -> TrainConfig:
    return decided(asked_for(options))


def read_config(path: Path) -> TrainConfig:
    return decided(read_said(path))


def test_a_configuration_comes_back_from_its_file(tmp_path: Path) -> None:
    config = replace(run_config(iterations=700, seed=3, formation="blur:2"), background=(0.0, 0.5, 1.0))
    (tmp_path / CONFIG).write_text(json.dumps(config_values(config)))
    assert config_values(read_config(tmp_path / CONFIG)) == config_values(config)
    for own in (config, tiny_config(), TrainConfig()):
        (tmp_path / CONFIG).write_text(json.dumps({"said": said_by(own), "train": {"seed": 99}}))
        assert read_config(tmp_path) == own


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"iteration": 3}, "unknown field 'iteration'; there are: iterations, method"),
        ({"iterations": "many"}, "iterations is 'many', wanted int"),
        ({"iterations": True}, "iterations is True, wanted int"),
        ({"densify": {"every": 0}}, "every is 0, wanted at least 1"),
        ({"densify": 3}, "wanted an object with fields, got 3"),
        ({"method": "4dgs"}, "unknown method '4dgs'"),
        ([], r"wanted an object with fields, got \[\]"),
        ({"train": {"iterations": 3}, "scene": None}, "of an older version of hqgs"),
    ],
)
def test_a_bad_file_is_told_by_field(values: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text(json.dumps(values))
    with pytest.raises(ValueError, match=message):
        read_config(tmp_path / "c.json")


def test_another_length_moves_the_schedule_but_not_what_was_set() -> None:
    short = run_config(iterations=600)
    assert with_iterations(short, 6000) == run_config(iterations=6000)
    own = replace(short, densify=replace(short.densify, every=7), sh_interval=11)
    longer = with_iterations(own, 6000)
    assert (longer.due.every, longer.due.sh_interval) == (7, 11)
    assert longer.due.stop == run_config(iterations=6000).due.stop
    # A number that is said counts as said, also where it is the one that nobody need say.
    same = replace(short, densify=replace(short.densify, start=short.due.start))
    assert with_iterations(same, 6000).due.start == short.due.start != run_config(iterations=6000).due.start
    assert "iterations" in run_config().leave_out
    assert "iterations" not in with_iterations(run_config(), 900).leave_out


def test_options_of_the_configuration_go_over_what_the_others_come_to(tmp_path: Path) -> None:
    chosen = options("--iterations", "600", "--config.densify.grad-threshold", "3e-4", "--seed", "5")
    wanted = run_config(iterations=600, seed=5)
    assert config_of(chosen) == replace(wanted, densify=replace(wanted.densify, grad_threshold=3e-4))
    several = options("--config.hqgs.no-held-pixels", "--config.lr-shN=2", "--config.turn", "3", "40")
    assert several.numbers == {"hqgs": {"held_pixels": False}, "lr_shN": 2.0, "turn": (3, 40)}
    assert options("--config.densify.grad-threshold", "3e-4", "--overwrite").overwrite
    assert config_of(options()) == run_config()
    quick = options("--preset", "quick")
    assert config_of(quick) == run_config(iterations=PRESETS["quick"].iterations)
    assert config_of(options("--preset", "quick", "--iterations", "50")) == run_config(iterations=50)
    file = tmp_path / "mine.json"
    file.write_text(json.dumps(said_by(wanted)))
    assert config_of(options("--config", file)) == wanted
    assert config_of(options("--config", file, "--iterations", "900")) == run_config(iterations=900, seed=5)
    assert config_of(options("--config", file, "--leave-out", "none")) == replace(wanted, leave_out=())
    assert config_of(options("--leave-out", "photos,growth")) == run_config(leave_out="photos,growth")


def test_a_run_keeps_what_was_said_and_what_was_decided_apart(tmp_path: Path) -> None:
    """So that one that goes on is that with what is said now, whatever that is."""
    train(tiny_scene(), out=tmp_path, iterations=3, method="3dgs", max_gaussians=900)
    kept = json.loads((tmp_path / CONFIG).read_text())
    assert kept["said"] == {"iterations": 3, "method": "3dgs", "densify": {"max_gaussians": 900}}
    assert kept["train"] == config_values(run_config(iterations=3, method="3dgs", max_gaussians=900))
    assert train(tiny_scene(), out=tmp_path, resume=True).iterations == 3  # as it was said
    run = train(tiny_scene(), out=tmp_path, iterations=6, resume=True)
    assert (run.iterations, run.report["config"]["method"]) == (6, "3dgs")
    assert asdict(decided(read_said(tmp_path)))["densify"]["max_gaussians"] == 900
    assert json.loads((tmp_path / CONFIG).read_text())["said"] == kept["said"] | {"iterations": 6}
    with pytest.raises(ValueError, match="--resume can make a run longer, not shorter"):
        train(tiny_scene(), out=tmp_path, iterations=5, resume=True)


@pytest.mark.parametrize("seconds", [None, 60.0])
def test_the_most_that_a_run_might_have_had_can_be_asked_for(tmp_path: Path, seconds: float | None) -> None:
    """config.json has that number although nobody asked for it."""
    file, wanted = tmp_path / CONFIG, run_config(iterations=TrainConfig.iterations)
    open_ended = replace(run_config(), seconds=seconds)
    said = {} if seconds is None else {"seconds": seconds}
    file.write_text(json.dumps({"said": said, "train": config_values(open_ended)}))
    assert config_of(options("--config", file, "--iterations", str(wanted.iterations))) == wanted
    (tmp_path / CHECKPOINT).touch()
    resumed = Train(scene="photos", out=tmp_path, resume=True, iterations=wanted.iterations)
    assert config_of(resumed) == wanted
    assert config_of(replace(resumed, iterations=None)).seconds == seconds


@pytest.mark.parametrize("said", [{}, {"iterations": 600}, {"leave_out": "none"}])
def test_what_is_said_again_changes_nothing(tmp_path: Path, said: dict[str, Any]) -> None:
    """On resume, and with the configuration of another run; only what differs is asked anew."""
    file, before = tmp_path / CONFIG, run_config(**said)
    loaded = LoadOptions(path="photos", test_every=5, longest=480)
    kept = {"said": said, "train": config_values(before), "scene": asdict(loaded)}
    file.write_text(json.dumps(kept))
    (tmp_path / CHECKPOINT).touch()
    same = ["--method", "auto", "--seed", "0", "--batch", "1"]
    same += ["--leave-out", "auto"] if before.leave_out else ["--leave-out", "none"]
    same += [] if "iterations" in before.leave_out else ["--iterations", str(before.iterations)]
    for resumed in (True, False):
        given = [*same, "--out", tmp_path, "--resume"] if resumed else [*same, "--config", file]
        assert config_of(options(*given)) == before
    resumed = [*same, "--out", tmp_path, "--resume"]
    asked = loading(options(*resumed), before)
    assert (asked["test_every"], asked["longest"]) == (5, 480)
    asked = loading(options(*resumed, "--test-every", "8", "--preset", "standard"), before)
    assert (asked["test_every"], asked["longest"]) == (8, 1600)
    asked = loading(options(*resumed, "--test-every", "0", "--downscale", "1"), before)
    assert (asked["test_every"], asked["longest"], asked["downscale"]) == (0, None, 1.0)


def test_every_field_of_the_configuration_is_an_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["train", "--help-all"])
    shown = capsys.readouterr().out.replace("_", "-")

    def check(values: dict[str, Any], prefix: str) -> None:
        for name, value in values.items():
            option = f"{prefix}{name.replace('_', '-')}"
            if isinstance(value, dict):
                check(value, f"{option}.")
            else:
                assert (f"{prefix}no-{name.replace('_', '-')}" if value is True else option) in shown

    check(config_values(TrainConfig()), "--config.")


def test_each_command_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    for name in COMMANDS:
        with pytest.raises(SystemExit, match="0"):
            main([name, "--help"])
        assert f"usage: hqgs {name}" in capsys.readouterr().out


def test_a_finished_run_trains_on_and_says_so(tmp_path: Path) -> None:
    scene, config = tiny_scene(), tiny_config(method="3dgs")
    first = train(scene, out=tmp_path, config=config)
    longer = replace(config, iterations=45)
    run = train(scene, out=tmp_path, config=longer, resume=True)
    assert (first.iterations, run.iterations, run.length) == (30, 45, 45)
    assert any("had ended at iteration 30" in note for note in run.report["notes"])
    with pytest.raises(ValueError, match="another seed"):
        train(scene, out=tmp_path, config=replace(longer, iterations=60, seed=1), resume=True)
    again = train(scene, out=tmp_path, config=longer, resume=True)
    assert again.model.means.equal(run.model.means)
    kept = json.loads((tmp_path / "config.json").read_text())
    assert read_config(tmp_path) == longer
    assert kept["scene"] is None


def test_the_verdict_rises_with_the_psnr() -> None:
    words = [verdict(psnr)[0] for psnr in (None, 14.7, 22.0, 27.0, 33.0)]
    assert words == ["not measured", "poor", "fair", "good", "very good"]
    assert "below 20 dB" in verdict(14.7)[1]
