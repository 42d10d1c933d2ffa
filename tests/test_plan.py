"""A run is planned once, by rules, from facts; what is decided later is added to what a resumed run reads."""

from __future__ import annotations

import json
import re
from dataclasses import FrozenInstanceError, asdict, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from planned import planned, repeated, run_config
from run_state import run_until
from test_diagnose import degraded_scene
from test_learned_cameras import textured_scene
from tiny_scene import tiny_config, tiny_scene

from hqgs.base.files import CHECKPOINT, PAGE, PLAN
from hqgs.base.typed import build
from hqgs.cli.main import main
from hqgs.photos.formula import parse_degradation
from hqgs.pipeline import open_run
from hqgs.scene.degrade import write_degraded_scene
from hqgs.training import rules
from hqgs.training.config import PRESETS, HQGSConfig, plan_values, with_iterations
from hqgs.training.plan import RunPlan, StepSeconds
from hqgs.training.prepare import Prepared, facts_of
from hqgs.training.rules import PIXELS, RULES, Draft, Rule, first_points_wanted, plan_run
from hqgs.training.trainer import Trainer
from hqgs.training.trial import _settings


def value(plan: RunPlan, what: str) -> str:
    return next(row.value for row in plan.rows if row.what == what)


def test_a_plan_follows_from_facts_alone_and_comes_back_from_json() -> None:
    config = tiny_config(method="auto", hqgs=HQGSConfig(formation="noise:12"))
    prepared = Prepared(tiny_scene(), config)
    plan = plan_run(prepared.facts, None, config)
    assert (
        plan
        == plan_run(prepared.facts, None, config)
        == prepared.plan()
        == Trainer(tiny_scene(), config).plan
    )
    assert build(RunPlan, json.loads(json.dumps(asdict(plan))), "here") == plan
    with pytest.raises(FrozenInstanceError):
        plan.discs = True  # type: ignore[misc]
    assert all(row.what and row.value and row.why and row.rule for row in plan.rows)
    assert (value(plan, "method"), value(plan, "formation")) == ("hqgs", "noise:12")
    assert f"{plan.settings.densify.max_gaussians:,} Gaussians" in value(plan, "budget")


def test_the_formation_is_what_the_photos_show_and_why() -> None:
    scene = degraded_scene("noise:25", photos=4)
    plan = Prepared(scene, run_config()).plan()
    row = next(row for row in plan.rows if row.what == "formation")
    assert row.value.startswith("noise:2")
    assert "levels" in row.evidence
    assert row.why == "found in the photos"
    none = next(row for row in plan.rows if row.what == "a correction for blur")
    assert (none.value, none.left_out) == ("none", "a correction for blur")


def test_photos_that_agree_on_no_more_points_have_the_rules_of_few() -> None:
    scene = textured_scene(8, 64)
    config = run_config(method="hqgs", formation="none")
    dense = Prepared(scene, config).plan()
    assert dense.discs
    assert dense.half_size_until
    flat = [replace(view, image=np.full(view.image.shape, 128, np.uint8)) for view in scene.train]
    plan = Prepared(replace(scene, train=flat), config).plan()
    assert plan.first_points == len(scene.points)
    row = next(row for row in plan.rows if row.what == "first points")
    assert (row.why, row.left_out) == ("no depth along an edge was confirmed by a second photo", None)
    assert (plan.discs, plan.half_size_until) == (False, 0)


def test_a_run_of_few_steps_starts_from_twice_as_many_points_that_photos_agree_on() -> None:
    config = run_config(iterations=50, method="hqgs", formation="none")
    facts = replace(Prepared(textured_scene(8, 64), config).facts, points=10)
    usual = facts.pixels // PIXELS
    longer = replace(config, iterations=20 * facts.photos)
    for agreed, asked, times in ((0.9, config, 2), (0.9, longer, 1), (0.6, config, 1), (None, config, 1)):
        plan = plan_run(replace(facts, agreed=agreed), None, asked)
        assert plan.first_points == times * facts.pixels // PIXELS, (agreed, asked.iterations)
    fewer = replace(config, start_points=usual // 4)
    assert first_points_wanted(replace(facts, agreed=0.9), fewer) == 2 * (usual // 4)


def test_a_repeat_of_seconds_starts_from_as_many_points(tmp_path: Path) -> None:
    """A run of seconds does not start from more where few steps fit into them."""
    asked = run_config(method="hqgs", formation="none")
    facts = replace(Prepared(textured_scene(8, 64), asked).facts, points=10, agreed=0.9)
    timed = replace(facts, seconds=StepSeconds(1.0, 0.25))
    run = plan_run(timed, None, replace(asked, seconds=1.0))
    assert run.settings.iterations < 20 * facts.photos
    (tmp_path / PLAN).write_text(json.dumps(plan_values(run.settings, [])))
    again = plan_run(facts, None, repeated(asked, tmp_path))
    assert (again.settings.iterations, again.first_points) == (run.settings.iterations, run.first_points)
    short = [_settings(of.settings, facts.photos, "none", 400) for of in (again, run)]  # of its trial
    assert short[0] == short[1]
    other = plan_run(facts, None, with_iterations(asked, run.settings.iterations))
    assert other.first_points > 1.9 * run.first_points


def test_a_list_leaves_out_only_what_it_names() -> None:
    """Beside that, a run is planned as by default."""

    def plan(items: str) -> RunPlan:
        return Prepared(
            textured_scene(8, 64), run_config(method="hqgs", formation="none", leave_out=items)
        ).plan()

    all_of_it, some = plan("photos,growth"), plan("growth,resolution")
    assert some.half_size_until == all_of_it.half_size_until > 0
    kept = [[row for row in p.rows if row.what != "left out at most"] for p in (some, all_of_it)]
    assert [(row.what, row.why) for row in kept[0]] == [(row.what, row.why) for row in kept[1]]
    assert not plan("photos").half_size_until
    assert not plan("growth").half_size_until


def test_a_rule_is_one_entry() -> None:
    def seed(draft: Draft) -> None:
        if draft.formed:
            draft.set(seed=7)
            draft.grow(every=3)
            draft.note("7", "for luck")

    facts = facts_of(tiny_scene())
    more = (*RULES, Rule("seed", seed, "nowhere"))
    config = tiny_config(method="auto", hqgs=HQGSConfig(formation="none"))
    plan = plan_run(facts, None, config, more)
    assert (plan.settings.seed, plan.settings.densify.every) == (7, 3)
    assert plan.rows[-1].rule == "seed: nowhere"
    assert plan_run(facts, None, tiny_config(), more).settings.seed == tiny_config().seed


def test_seconds_are_a_fact_of_the_machine() -> None:
    config = replace(run_config(method="3dgs"), seconds=60.0)
    facts = replace(facts_of(tiny_scene()), as_photographed=True)
    slow, fast = (plan_run(replace(facts, seconds=StepSeconds(s, s / 4)), None, config) for s in (0.1, 0.01))
    assert slow.settings.iterations == pytest.approx(60 / (0.1 * rules.SLOWER), rel=0.01)
    assert fast.settings.iterations == pytest.approx(60 / (0.01 * rules.SLOWER), rel=0.01)
    assert slow.clock_most == rules.MOST_ITERATIONS
    assert not planned(config, tiny_scene().train).clock_most


def test_what_is_decided_later_is_added_and_a_resumed_run_reads_the_same(tmp_path: Path) -> None:
    config = tiny_config(30, turn=(20, 26))
    trainer = Trainer(tiny_scene(), config)
    before = trainer.plan
    assert run_until(trainer, 22).plan is before
    assert [(row.what, row.value, row.iteration) for row in trainer.state.rows] == [
        ("length", "26 iterations", 20)
    ]
    trainer.save(tmp_path / "checkpoint")
    again = Trainer(tiny_scene(), config)
    again.restore(tmp_path / "checkpoint")
    assert (again.plan.rows, again.state.rows) == (trainer.plan.rows, trainer.state.rows)
    assert run_until(again).iteration == 26


def test_a_run_of_seconds_resumes_by_the_same_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped in the middle, and at its end: its length is the one that was planned, not 30,000."""
    monkeypatch.setattr(rules, "FEWEST_ITERATIONS", 40)
    monkeypatch.setattr(rules, "MOST_ITERATIONS", 41)

    config = replace(run_config(leave_out="none", method="3dgs"), seconds=1e3)

    def goes_on(to: int) -> Trainer:
        with open_run(tiny_scene(), config, tmp_path, resume=True) as trainer:
            while trainer.iteration < min(to, trainer.length):  # which may change
                trainer.step()
            trainer.save(tmp_path / CHECKPOINT)
        return trainer

    plan = goes_on(12).plan
    assert plan.settings.iterations == 40
    ended = goes_on(30_000)
    assert (ended.plan, ended.iteration) == (plan, ended.length)
    assert ended.length < 200
    assert goes_on(30_000).iteration == ended.iteration


def test_two_photos_of_one_name_are_refused() -> None:
    """They would share what is learned of their cameras."""
    scene = tiny_scene()
    twins = replace(scene, train=[*scene.train, replace(scene.train[0])])
    with pytest.raises(ValueError, match=r"2 training views of scene 'tiny' are named 'view1.png'"):
        Trainer(twins, tiny_config())


def test_the_command_prints_what_the_page_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = tmp_path / "desk", tmp_path / "run"
    write_degraded_scene(tiny_scene(), scene, parse_degradation("none"), 0)
    options = ["--formation", "noise:9", "--iterations", "12"]
    assert main(["plan", str(scene), *options]) == 0
    said = capsys.readouterr().out
    assert main(["train", str(scene), "--out", str(out), *options]) == 0
    trained = capsys.readouterr().err
    rows = json.loads((out / "report.json").read_text())["plan"]
    page = (out / PAGE).read_text()
    for row in rows:
        assert row["what"] in said
        assert row["value"] in said
        assert row["value"].replace("'", "&#39;").replace(">", "&gt;") in page
    assert "noise:9" in trained
    assert "12 iterations" in trained


def test_the_command_takes_photos_of_the_size_that_a_run_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_degraded_scene(tiny_scene(), tmp_path, parse_degradation("none"), 0)
    told = []
    for longest in (1600, 20):
        monkeypatch.setitem(PRESETS, "standard", replace(PRESETS["standard"], longest=longest))
        assert main(["plan", str(tmp_path), "--formation", "noise:9"]) == 0
        found = re.search(r"the\s+detail\s+of\s+([\d,]+)\s+sharp", capsys.readouterr().out)
        assert found is not None
        told.append(int(found[1].replace(",", "")))
    assert told[1] < told[0] / 1.2


def test_photos_alone_have_a_plan_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    for view in degraded_scene("noise:25", photos=4).train:
        pixels = (view.image.clip(0, 1) * 255).round().astype("uint8")
        Image.fromarray(pixels).save(tmp_path / view.name)
    assert main(["plan", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "noise:2" in said
    assert "not known before hqgs train has found the poses" in said
