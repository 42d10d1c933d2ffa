"""Runs that have a number of seconds."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from planned import planned, repeated, run_config
from run_state import assert_same, whole_state
from test_diagnose import inspected
from test_learned_cameras import textured_scene
from tiny_scene import tiny_config, tiny_scene

import hqgs
from hqgs.base.files import CHECKPOINT, CONFIG, PLAN, PLY
from hqgs.cli.main import main
from hqgs.photos.formula import parse_degradation
from hqgs.scene.degrade import write_degraded_scene
from hqgs.training import rules
from hqgs.training.config import DensifyConfig, TrainConfig, plan_values, with_iterations
from hqgs.training.notes import run_notes
from hqgs.training.plan import StepSeconds
from hqgs.training.rules import FOR_EACH_PHOTO, GROWS_FROM, LEAST_ENOUGH, PIXELS
from hqgs.training.schedule import Schedule
from hqgs.training.trainer import Trainer, by_the_clock, fit_to_seconds

N, STOP = 300, 200


def turned_at(seconds: float, step: float, most: int = 10**6, **changes: Any) -> tuple[int, int]:
    """When a run of N steps gets another length, `most` at most, and which; each step takes `step` s."""
    config = tiny_config(N, densify=DensifyConfig(stop=STOP), seconds=seconds, **changes)
    views = tiny_scene().train
    schedule = Schedule.of(replace(planned(config, views), clock_most=most), len(views))
    decisions, iteration = schedule.start(), 0
    while iteration < decisions.length:
        iteration += 1
        decisions = by_the_clock(schedule, decisions, iteration, iteration * step, step)
    assert schedule.part(iteration, decisions) == pytest.approx(1.0)
    assert schedule.densification_end(decisions) == STOP
    return decisions.turned, iteration


def test_after_growth_the_rest_of_a_run_follows_the_clock() -> None:
    at = STOP + 33  # a third of what is left
    assert turned_at(seconds=30.0, step=0.1) == (at, 300)
    assert turned_at(seconds=35.0, step=0.1) == (at, 350)
    assert turned_at(seconds=27.0, step=0.1) == (at, 270)
    assert turned_at(seconds=1.0, step=0.1) == (at, at + 7)  # a tenth of what was planned is left
    assert turned_at(seconds=1e6, step=0.1) == (at, at + 268)  # four times as much
    assert turned_at(seconds=1e6, step=0.1, most=320) == (at, 320)
    assert turned_at(seconds=1e6, step=0.1, most=N) == (0, N)  # more do not pay
    assert turned_at(seconds=27.0, step=0.1, most=N) == (at, 270)  # nor does it take longer than asked for
    assert turned_at(seconds=1.0, step=0.1, turn=(260, 280)) == (260, 280)  # a plan, not the clock


def test_as_many_iterations_as_fit() -> None:
    """A full step takes 0.1 s, one at half size 0.02 s, before the scene grows."""
    steps = StepSeconds(full=0.1, half=0.02)
    fits = rules.fitting(60.0, steps, 1.0, True)
    assert (0.6 * 0.02 + 0.4 * 0.1) * rules.SLOWER * fits == pytest.approx(60.0, rel=2e-2)
    dense = rules.fitting(60.0, steps, 3.0, True)
    assert dense == pytest.approx(fits * rules.SLOWER / rules.SLOWER_DENSE, abs=2)
    assert rules.fitting(60.0, steps, 1.0, True, most=100) == 100
    assert rules.fitting(1e-3, steps, 1.0, True) == rules.FEWEST_ITERATIONS
    assert rules.fitting(1e9, steps, 1.0, True) == pytest.approx(rules.MOST_ITERATIONS, abs=1)


@pytest.mark.parametrize("formation", ["none", "exposure", "noise:12"])
def test_steps_that_are_timed_leave_nothing_behind(formation: str, tmp_path: Path) -> None:
    config = run_config(method="hqgs", formation=formation)
    trainer = Trainer(tiny_scene(12), replace(config, seconds=1e-3))
    fit_to_seconds(trainer)
    (tmp_path / PLAN).write_text(json.dumps(plan_values(trainer.config, [])))
    again = Trainer(tiny_scene(12), repeated(config, tmp_path))
    for _ in range(6):
        trainer.step()
        again.step()
    first, second = whole_state(trainer, tmp_path / "a"), whole_state(again, tmp_path / "b")
    assert_same((first[0], {}), (second[0], {}))


def test_a_resumed_run_of_seconds_knows_how_long_its_steps_take(tmp_path: Path) -> None:
    trainer = Trainer(tiny_scene(), replace(run_config(method="3dgs"), seconds=1e-3))
    fit_to_seconds(trainer)
    for _ in range(3):
        trainer.step()
    trainer.save(tmp_path / CHECKPOINT)
    again = Trainer(tiny_scene(), trainer.asked)
    again.restore(tmp_path / CHECKPOINT)
    assert again.state.step_seconds == trainer.state.step_seconds > 0


def test_a_run_of_seconds_is_repeated_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rules, "FEWEST_ITERATIONS", 30)
    monkeypatch.setattr(rules, "MOST_ITERATIONS", 31)
    scene, config = tiny_scene(), run_config(iterations=500, leave_out="none", method="3dgs")
    run = hqgs.train(scene, out=tmp_path / "a", config=config, seconds=0.5)
    plan = json.loads((tmp_path / "a" / PLAN).read_text())
    assert plan["iterations"] == 30
    at, length = plan["turn"]
    assert (at, length) == (23, run.iterations)
    assert run.report["config"]["turn"] == (at, length)
    assert any("planned for 0.5 s" in note for note in run.report["notes"])
    again = hqgs.train(scene, out=tmp_path / "b", config=repeated(config, tmp_path / "a"))
    assert again.iterations == run.iterations
    assert (tmp_path / "a" / PLY).read_bytes() == (tmp_path / "b" / PLY).read_bytes()
    other = hqgs.train(scene, config=with_iterations(config, 30))
    assert (other.iterations == run.iterations) == (length == 30)
    kept = json.loads((tmp_path / "a" / CONFIG).read_text())["train"]
    assert (kept["iterations"], kept["seconds"]) == (TrainConfig.iterations, 0.5)  # as it was asked for


def test_a_run_of_seconds_looks_at_each_photo_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although it is prepared twice: to be timed, and to be trained."""
    seen = inspected(monkeypatch)
    monkeypatch.setattr(rules, "FEWEST_ITERATIONS", 5)
    monkeypatch.setattr(rules, "MOST_ITERATIONS", 6)
    scene = tiny_scene()
    hqgs.train(scene, seconds=0.1)
    assert sorted(seen) == sorted(view.name for view in scene.train)


def test_bad_plans_and_seconds_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = run_config(iterations=100)
    with pytest.raises(FileNotFoundError, match="there is no plan"):
        repeated(config, tmp_path)
    for text in (
        "{",
        "[]",
        '{"iterations": 10}',
        '{"iterations": 10, "turn": [5]}',
        '{"iterations": 0, "turn": null}',
    ):
        (tmp_path / PLAN).write_text(text)
        with pytest.raises(ValueError, match="is not a plan"):
            repeated(config, tmp_path)
    for seconds in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="seconds is"):
            TrainConfig(seconds=seconds)
    for turn in ((5, 5), (0, 7)):
        with pytest.raises(ValueError, match="turn is"):
            TrainConfig(turn=turn)
    with pytest.raises(ValueError, match="only one of them"):
        hqgs.train(tiny_scene(), iterations=10, seconds=3.0)
    argv = ["train", "embedded", "--out", str(tmp_path / "r"), "--seconds", "5", "--iterations", "10"]
    assert main(argv) == 2
    assert "only one of --iterations and --seconds" in capsys.readouterr().err


def test_clean_photos_start_from_points_that_they_agree_on() -> None:
    scene = textured_scene(8, 96)
    pixels = sum(view.image[..., 0].size for view in scene.train)
    few = replace(
        scene,
        points=scene.points[::20],
        point_colors=scene.point_colors[::20],
        seen={name: rows[rows % 20 == 0] // 20 for name, rows in (scene.seen or {}).items()},
    )

    def trainer(method: str = "auto", **changes: Any) -> Trainer:
        return Trainer(few, replace(run_config(iterations=50, method=method, formation="none"), **changes))

    dense = trainer()
    assert 2 * len(few.points) < len(dense.gaussians) <= max(2 * pixels // PIXELS, 1.5 * len(few.points))
    assert "resolution" in dense.config.leave_out
    assert dense.config.due.start == GROWS_FROM
    assert any(
        item.what == f"densification in the first {GROWS_FROM} iterations" for item in dense.left_out()
    )
    own = trainer(start_points=0)
    assert len(own.gaussians) == len(few.points)
    assert own.config.due.start < GROWS_FROM
    plain = trainer("3dgs")
    assert len(plain.gaussians) == len(few.points)
    assert "resolution" not in plain.config.leave_out
    assert asdict(trainer(leave_out=("growth",)).config)["leave_out"] == ("growth",)


def test_clean_photos_are_not_looked_at_more_often_than_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no number of iterations is given, or more seconds than that takes."""
    scene = textured_scene(8, 96)
    length = "iterations 4001 to 30000"

    def trainer(**changes: Any) -> Trainer:
        return Trainer(scene, run_config(formation="none", **changes))

    short = trainer()
    assert short.config.iterations == LEAST_ENOUGH == 4_000
    assert short.config.due.stop == run_config(iterations=LEAST_ENOUGH).due.stop
    assert "iterations" not in short.config.leave_out  # nothing is held back for it
    assert length in [item.what for item in short.left_out()]
    assert trainer(eval_every=123).config.eval_every == 123
    asked = trainer(iterations=9_000)
    assert asked.config.iterations == 9_000
    assert "asked for; with 7 photos more than 4,000 seldom improve the scene" in [
        row.why for row in asked.plan.rows
    ]
    assert "asked for" in [row.why for row in trainer(iterations=4_000).plan.rows if row.what == "length"]
    assert trainer(leave_out="none").config.iterations == 30_000
    assert trainer(method="3dgs").config.iterations == 30_000
    noisy = Trainer(scene, run_config(formation="noise:20"))  # 7 photos, of which none can be held back
    assert noisy.config.iterations == 7_000
    assert "no validation photo can be set aside to find the best length" in [
        row.why for row in noisy.plan.rows
    ]
    for name in ("ENOUGH", "LEAST_ENOUGH"):
        monkeypatch.setattr(f"hqgs.training.rules.{name}", 700)
    many = trainer()
    assert many.config.iterations == FOR_EACH_PHOTO * len(scene.train) == 1_050
    assert "iterations" in many.config.leave_out

    def timed(seconds: float) -> Trainer:
        trainer = Trainer(scene, replace(run_config(formation="none"), seconds=seconds))
        fit_to_seconds(trainer)
        return trainer

    long = timed(1e6)
    assert long.config.iterations == long.plan.clock_most == 1_050
    assert any("more iterations seldom improve the scene" in note for note in run_notes(long))
    short_of = timed(1e-3)
    assert (short_of.config.iterations, short_of.plan.clock_most) == (rules.FEWEST_ITERATIONS, 1_050)


def test_a_run_without_a_number_can_be_made_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hqgs.training.rules.LEAST_ENOUGH", 20)
    monkeypatch.setattr("hqgs.training.rules.FOR_EACH_PHOTO", 1)
    scene, out = tmp_path / "desk", tmp_path / "run"
    write_degraded_scene(tiny_scene(), scene, parse_degradation("none"), 0)
    argv = ["train", str(scene), "--out", str(out), "--formation", "none"]
    assert main(argv) == 0
    assert json.loads((out / "report.json").read_text())["iterations"] == 20
    assert main([*argv, "--resume", "--iterations", "30"]) == 0
    assert json.loads((out / "report.json").read_text())["iterations"] == 30
    assert main([*argv, "--resume", "--iterations", "25"]) == 2


def test_a_run_of_seconds_can_be_stopped_resumed_and_made_longer(tmp_path: Path) -> None:
    scene, out = tmp_path / "desk", tmp_path / "run"
    write_degraded_scene(tiny_scene(), scene, parse_degradation("none"), 0)
    argv = ["train", str(scene), "--out", str(out), "--method", "3dgs"]
    assert main([*argv, "--seconds", "0.3"]) == 0
    first = json.loads((out / "report.json").read_text())
    assert first["config"]["seconds"] == 0.3
    planned = first["config"]["iterations"]
    longer = first["iterations"] + (20 if planned != first["iterations"] + 20 else 21)  # of fewer or more
    assert main([*argv, "--resume", "--iterations", str(longer)]) == 0
    assert json.loads((out / "report.json").read_text())["iterations"] == longer
    assert main([*argv, "--overwrite", "--seconds", "0"]) == 2
