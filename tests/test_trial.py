"""The trial of growth before a run: what is held back, what is compared, and what the plan makes of it."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from planned import run_config
from run_state import run_until
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

from hqgs.base.files import CHECKPOINT
from hqgs.base.stages import Stage
from hqgs.diagnosis.photo import Finding
from hqgs.diagnosis.scene import Diagnosis, Inspector
from hqgs.evaluation.held_out import RenderedView
from hqgs.scene.scene import Scene
from hqgs.training import prepare, trial
from hqgs.training.config import TrainConfig
from hqgs.training.plan import Facts, RunPlan, StepSeconds, Tried
from hqgs.training.rules import no_growth, plan_run
from hqgs.training.trainer import Trainer

ASKED = run_config(iterations=1000, method="hqgs", formation="none")
FIRST, GAUSSIAN = 40, 80  # points that the fake runs start from; pixels a Gaussian of one that does not grow


def facts(tried: Tried | None = None) -> Facts:
    """Of photos that call for 100 first points."""
    sizes = ((100, 100),) * 10
    return Facts(10, 10_000, 100, 50, True, 0.7, as_photographed=True, sizes=sizes, tried=tried)


def told(plan: RunPlan) -> str:
    return next(row.evidence for row in plan.rows if row.what == "densification")


@pytest.mark.parametrize(
    ("gain", "sure", "grows"),
    [
        (-1.98, -5.0, True),
        (0.99, 2.5, False),
        (0.5, 1.2, False),
        (0.3, 0.8, False),
        (0.1, -0.1, True),
        (0.02, 2.0, False),
    ],
)
def test_nothing_grows_where_photos_held_back_are_better_for_it(
    gain: float, sure: float, grows: bool
) -> None:
    tried = Tried(gain, 0.4, photos=6, sure=sure)
    plan = plan_run(facts(tried), None, ASKED)
    due = plan.settings.due
    assert (next(row.value for row in plan.rows if row.what == "densification") != "none") == grows
    assert (due.start < due.stop) == grows
    assert f"{gain:+.2f} ± 0.40 dB on 6 validation photos" in told(plan)
    long = plan_run(facts(tried), None, run_config(iterations=7000, method="hqgs", formation="none"))
    assert (long.settings.densify.reset_every < long.settings.due.stop) == grows
    noisy = replace(ASKED, hqgs=replace(ASKED.hqgs, formation="noise:25"))  # which have a budget of their own
    assert plan_run(facts(tried), None, noisy).settings == plan_run(facts(), None, noisy).settings


class FakeRun:
    """A trainer whose renders are the worse, the more Gaussians there may be."""

    def __init__(self, scene: Scene, config: TrainConfig) -> None:
        self.scene, self.iteration, self.length = scene, 0, config.iterations
        self.plan = RunPlan(config, FIRST, True, True, 0, 0, 0)

    def begin(self, plan: RunPlan) -> None:
        self.plan, self.iteration = plan, 0

    def branch(self, plan: RunPlan) -> FakeRun:
        assert 0 < self.iteration == self.plan.settings.due.start < self.length  # where growth starts
        other = copy(self)
        other.plan = plan
        return other

    def step(self) -> None:
        self.iteration += 1

    def held_out(self) -> list[RenderedView]:
        assert self.iteration == self.length == trial.STEPS
        growth, due = self.plan.settings.densify, self.plan.settings.due
        pixels = sum(view.camera.width * view.camera.height for view in self.scene.train)
        level = growth.max_gaussians / pixels if due.start < due.stop else 1 / GAUSSIAN
        rng = np.random.default_rng(0)
        found = []
        for view in self.scene.test:
            error = 0.5 * level * rng.choice([-1, 1], view.image.shape)
            render = (view.image / 255 + error).astype(np.float32)
            found.append(RenderedView(view.name, view.image, render))
        return found


def test_short_runs_are_judged_by_photos_that_they_have_not_seen() -> None:
    scene, seen = tiny_scene(12), list[Scene]()

    def begin(part: Scene, config: TrainConfig) -> FakeRun:
        seen.append(part)
        assert config.leave_out == ()  # nothing is tried within a trial
        assert (config.opacity_decay, config.hqgs.formation) == (0.0, "none")
        return FakeRun(part, config)

    plan = RunPlan(replace(ASKED, iterations=10**6, leave_out=("growth",)), FIRST, True, True, 0, 0, 0)
    found = trial.tried_growth(scene, plan, begin)  # type: ignore[arg-type]
    names = [view.name for view in scene.train]
    (part,) = seen  # the first photos tell it clearly
    assert [view.name for view in part.test] == names[trial.OFFSETS[0] :: trial.EACH]
    assert sorted(view.name for view in (*part.train, *part.test)) == sorted(names)
    assert found is not None
    assert found.photos == len(part.test)
    assert found.gain == pytest.approx(20 * np.log10(GAUSSIAN / trial.PIXELS), abs=0.3)  # as errors are
    assert found.error < 0.1
    assert found.sure > 1  # renders without growth are better by each measure


class Unsure(FakeRun):
    """A trainer of which every second photo held back is better if nothing grows."""

    def held_out(self) -> list[RenderedView]:
        still = self.plan.settings.due.start >= self.plan.settings.due.stop
        views, rng = self.scene.test, np.random.default_rng(0)
        off = [0.1 if still == k % 2 else 0.11 for k in range(len(views))]
        noise = [by * rng.choice([-1, 1], view.image.shape) for by, view in zip(off, views, strict=True)]
        renders = [view.image / 255 + by for view, by in zip(views, noise, strict=True)]
        return [
            RenderedView(v.name, v.image, r.astype(np.float32)) for v, r in zip(views, renders, strict=True)
        ]


def test_others_are_held_back_where_the_first_photos_do_not_tell() -> None:
    scene, seen = tiny_scene(12), list[Scene]()
    plan = RunPlan(replace(ASKED, iterations=10**6), FIRST, True, True, 0, 0, 0)
    found = trial.tried_growth(scene, plan, lambda *of: seen.append(of[0]) or Unsure(*of))  # type: ignore[arg-type]
    names = [[view.name for view in part.test] for part in seen]
    assert names == [[view.name for view in scene.train[k :: trial.EACH]] for k in trial.OFFSETS]
    assert found is not None
    assert found.photos == sum(map(len, names))
    assert not found.pays


class FakeLooks(FakeRun):
    """A trainer whose renders are off the photos by what its formation leaves."""

    off: ClassVar = {"none": 0.1, "exposure": 0.11, "response": 0.05}
    blurred: ClassVar = {"response": 0.05, "shake+response": 0.03}
    dark: ClassVar = {
        "vignetting": 0.1, "exposure+vignetting": 0.05, "exposure+vignetting+response": 0.04,
        "shake+exposure+vignetting+response": 0.03,
    }  # fmt: skip

    def begin(self, plan: RunPlan) -> None:
        super().begin(plan)
        self.tried = [*getattr(self, "tried", []), plan.settings.hqgs.formation]

    def taken(self, number: int) -> NDArray[np.float32]:
        assert self.iteration == self.length
        view = self.scene.train[number]
        assert view.mask is not None
        hidden = ~view.mask[..., None]
        assert hidden.mean() == 0.5
        error = (self.off | self.blurred | self.dark)[self.tried[-1]] * np.random.default_rng(number).choice(
            [-1, 1], view.image.shape
        )
        return np.where(hidden, view.image / 255 + error, 9.0).astype(np.float32)


def test_a_look_is_kept_where_photos_held_back_gain_by_it() -> None:
    scene, runs, stages = tiny_scene(24), list[FakeLooks](), list[Stage]()
    train = [replace(view, device="ab"[k % 4 == 1]) for k, view in enumerate(scene.train)]

    def begin(part: Scene, config: TrainConfig) -> FakeLooks:
        halves = [view for view in part.train if view.mask is not None]
        assert {view.device for view in part.train} == {view.device for view in halves} == {"a", "b"}
        assert len(part.train) == (16 if runs else 23)  # some, where each photo must be looked at often
        assert part.test == []
        runs.append(FakeLooks(part, config))
        return runs[-1]

    asked, dark = (
        replace(ASKED, hqgs=replace(ASKED.hqgs, formation=f"exposure+{lens}response+shake+focus+noise:12"))
        for lens in ("", "vignetting+")
    )
    found = trial.tried_looks(replace(scene, train=train), asked, begin, stages.append)  # type: ignore[arg-type]
    assert [run.tried for run in runs] == [[*FakeLooks.off], [*FakeLooks.blurred]]
    assert {name: tried.pays for name, tried in found.items()} == {
        "exposure": False, "response": True, "shake": True,
    }  # fmt: skip
    assert found["response"].gain == pytest.approx(20 * np.log10(2), abs=0.6)
    assert {(now.done, now.total) for now in stages} >= {(600, 600), (640, 640)}
    assert trial.tried_looks(scene, ASKED, begin) == {}  # type: ignore[arg-type]
    runs.clear()
    found = trial.tried_looks(replace(scene, train=train), dark, begin)  # type: ignore[arg-type]
    assert [name for name, tried in found.items() if tried.pays] == ["exposure", "response", "shake"]
    assert {one for run in runs for one in run.tried} == set(FakeLooks.dark)  # a lens is not tried


def found_of(*names: str) -> Diagnosis:
    parts = tuple(Finding(name, f"{name} is seen", name, 0.2) for name in names)
    return Diagnosis("room", "+".join(names), parts, (), ())


def test_a_run_learns_no_look_that_does_not_pay() -> None:
    looks = {"exposure": Tried(0.8, 0.2, 6, 4.0), "vignetting": Tried(-3.1, 0.4, 6, -7.0)}
    asked = replace(ASKED, hqgs=replace(ASKED.hqgs, formation="auto"))
    plan = plan_run(replace(facts(), looks=looks), found_of("exposure", "vignetting"), asked)
    assert plan.settings.hqgs.formation == "exposure"
    rows = {row.what: row for row in plan.rows}
    assert "+0.80 ± 0.20 dB on 6 validation photos" in rows["formation"].evidence
    left = rows["a learned vignetting"]
    assert left.left_out is not None
    assert left.evidence == "-3.10 ± 0.40 dB on 6 validation photos of short test runs"


def test_a_resumed_run_learns_the_looks_that_paid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries, file = list[None](), tmp_path / CHECKPOINT
    looks = {"exposure": Tried(0.8, 0.2, 6, 4.0), "vignetting": Tried(-3.1, 0.4, 6, -7.0)}
    monkeypatch.setattr(prepare, "tried_looks", lambda *of: tries.append(None) or looks)
    monkeypatch.setattr(Inspector, "diagnose", lambda *of: found_of("exposure", "vignetting"))
    scene = tiny_scene(6, num_points=10)
    config = run_config(iterations=2, method="hqgs", leave_out="growth")
    for iterations in (2, 4):
        trainer = Trainer(scene, replace(config, iterations=iterations), tries=not file.exists())
        if file.exists():
            trainer.restore(file)
        run_until(trainer)
        assert {group["name"] for group in trainer.method.param_groups()} == {"gains"}
        trainer.save(file)
    assert (trainer.iteration, len(tries)) == (4, 1)


def test_a_trial_takes_a_small_share_of_a_run_and_needs_photos_to_spare() -> None:
    scene = tiny_scene(12)
    plan = RunPlan(replace(ASKED, iterations=10**6), FIRST, True, True, 0, 0, 0)
    assert trial.calls_for_trial(scene, plan)
    assert not trial.calls_for_trial(scene, replace(plan, settings=ASKED))
    assert not trial.calls_for_trial(replace(scene, train=scene.train[:4]), plan)
    still = replace(plan.settings, densify=replace(ASKED.densify, stop=0))
    assert not trial.calls_for_trial(scene, replace(plan, settings=still))


def test_a_run_is_planned_by_its_trial_and_the_same_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "STEPS", 20)
    monkeypatch.setattr(trial, "SHARE", np.inf)
    scene = tiny_scene(12, num_points=10)
    seen = {view.name: np.arange(10) for view in scene.train}
    config = run_config(iterations=1000, method="hqgs", leave_out="growth", formation="none")
    first, again = (Trainer(replace(scene, seen=seen), config).plan for _ in range(2))
    assert first == again
    assert "validation photos" in told(first)
    assert told(Trainer(replace(scene, seen=seen), replace(config, leave_out=())).plan) == ""


def test_a_resumed_run_goes_by_the_trial_that_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepare, "calls_for_trial", lambda scene, plan: True)
    trials = list[None]()
    monkeypatch.setattr(prepare, "tried_growth", lambda *of: trials.append(None) or Tried(1.0, 0.1, 6, 10.0))
    scene = tiny_scene(12, num_points=10)
    scene = replace(scene, seen={view.name: np.arange(10) for view in scene.train})
    config = run_config(iterations=2, method="hqgs", leave_out="growth", formation="none")
    file = tmp_path / CHECKPOINT
    for iterations in (2, 2, 4):  # as it was, and longer
        going_on = file.exists()
        trainer = Trainer(scene, replace(config, iterations=iterations), tries=not going_on)
        if going_on:
            trainer.restore(file)
        run_until(trainer)
        assert "validation photos" in told(trainer.plan)
        trainer.save(file)
    assert (trainer.iteration, len(trials)) == (4, 1)


def test_a_run_of_seconds_is_tried_when_its_length_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    asked_for = list[int]()
    monkeypatch.setattr(
        prepare, "calls_for_trial", lambda scene, plan: bool(asked_for.append(plan.settings.iterations))
    )
    scene = tiny_scene(12, num_points=10)
    config = run_config(iterations=1000, method="hqgs", leave_out="growth", formation="none")
    seen = {view.name: np.arange(10) for view in scene.train}
    trainer = Trainer(replace(scene, seen=seen), replace(config, seconds=2.0))
    assert asked_for == []
    trainer.prepared.plan(StepSeconds(0.01, 0.0))
    assert asked_for == [200]


def test_a_branch_comes_to_what_a_run_by_its_plan_comes_to() -> None:
    config = tiny_config(30)
    still = replace(config, densify=replace(config.densify, **no_growth(config)))
    scene, ends = tiny_scene(12), list[list[Tensor]]()
    first, *others = (Trainer(scene, asked) for asked in (config, config, still))
    while first.iteration < config.due.start:
        first.step()
    for run in (first.branch(others[1].plan), first, *others):  # the copy first: neither moves the other
        while run.iteration < run.length:
            run.step()
        ends.append([tensor.detach() for tensor in run.shown().named().values()])
    assert [len(end[0]) for end in ends] == [len(end[0]) for end in (ends[3], ends[2], ends[2], ends[3])]
    assert len(ends[2][0]) != len(ends[3][0])
    for one, other in ((0, 3), (1, 2)):
        assert all(map(torch.equal, ends[one], ends[other]))
