"""The schedule: what each step does, against lists made by hand; and the example of a method."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from example_method import Tinted, install, loss_of
from planned import schedule_of
from run_state import assert_stopped_alike
from tiny_scene import tiny_config, tiny_scene

from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.scene import Camera, View
from hqgs.training.config import DensifyConfig, HQGSConfig, TrainConfig
from hqgs.training.schedule import FINEST, Decisions, Schedule, StepPlan, learning_rates, low_pass
from hqgs.training.trainer import Trainer

DENSIFY = DensifyConfig(start=20, stop=61, every=10, reset_every=25)


def views(count: int) -> list[View]:
    return [replace(tiny_scene().train[0], name=f"{k}.png") for k in range(count)]


def schedule(config: TrainConfig, count: int = 5) -> Schedule:
    return schedule_of(config, views(count))


def plans(schedule: Schedule, decisions: Decisions | None = None, count: int = 99) -> list[StepPlan]:
    decisions = decisions or schedule.start()
    return [schedule.plan(iteration, decisions) for iteration in range(1, count + 1)]


def test_growth_and_resets() -> None:
    made = plans(schedule(tiny_config(100, densify=DENSIFY)))
    assert [plan.iteration for plan in made if plan.densifies] == [30, 40, 50, 60]
    assert [plan.iteration for plan in made if plan.resets] == [26, 51]  # before the step after 25 and 50
    assert [plan.iteration for plan in made if plan.observes] == list(range(1, 61))
    assert {plan.finest for plan in made} == {None}


def test_a_plan_follows_from_its_arguments_alone() -> None:
    config = tiny_config(100, densify=DENSIFY, leave_out=("growth", "resolution"))
    forwards = plans(schedule(config))
    backwards = schedule(config)
    again = [backwards.plan(k, backwards.start()) for k in range(99, 0, -1)]
    assert again[::-1] == forwards


def test_a_shortened_run_squeezes_the_rest() -> None:
    densify = replace(DENSIFY, stop=900)
    timetable = schedule(tiny_config(1_000, densify=densify, leave_out=("iterations",)), count=12)
    assert timetable.held == (6,)
    held = plans(timetable, count=300)
    assert {plan.view for plan in held} == set(range(12)) - {6}
    decisions = replace(timetable.start(), length=450, released=300)
    rest = [timetable.plan(k, decisions) for k in range(301, 451)]
    assert {plan.view for plan in rest} == set(range(12))
    assert rest[-1].part == pytest.approx(1.0)
    assert rest[74].part == pytest.approx((0.3 + 1.0) / 2)
    assert [plan.iteration for plan in rest if plan.observes] == list(range(301, 375))  # 1.25 x 300


def test_a_coarse_beginning_has_coarser_limits() -> None:
    view = views(1)[0]
    large = replace(view, camera=replace(view.camera, width=64, height=64))
    config = tiny_config(100, leave_out=("growth", "resolution"))
    timetable = schedule_of(config, [large] * 3)
    made = plans(timetable)
    assert [plan.coarse for plan in made] == [True] * 60 + [False] * 39
    assert [made[k].finest for k in (0, 59, 60)] == [2 * FINEST, 2 * FINEST, FINEST]
    assert schedule_of(replace(config, iterations=9_000), [large] * 3).run.half_size_until == 1_500
    degraded = schedule_of(config, [large] * 3, as_photographed=False)
    assert degraded.run.settings.leave_out == ()
    assert not any(plan.coarse or plan.finest for plan in plans(degraded))


def test_the_degree_rises_to_that_of_the_configuration() -> None:
    timetable = schedule(tiny_config(100, sh_interval=10, sh_degree=2))
    degrees = [plan.degree for plan in plans(timetable, count=40)]
    assert degrees == [0] * 9 + [1] * 10 + [2] * 21


@pytest.mark.parametrize(
    ("iterations", "faster", "last"),
    [
        (30_000, 1.0, 1.6e-6),
        (15_000, 2**0.3, 1.6e-6 * 2**1.5),
        (7_500, 4**0.3, 8 * 1.6e-6),
        (100, 2.0, 1.6e-4 / 3),
    ],
)
def test_short_runs_may_have_higher_rates(iterations: int, faster: float, last: float) -> None:
    plain, short = TrainConfig(iterations=iterations), TrainConfig(iterations=iterations, faster_rates=True)
    before, rates = (learning_rates(config, extent=2.0, part=1.0) for config in (plain, short))
    assert before["means"] == pytest.approx(2 * 1.6e-6)
    assert rates["means"] == pytest.approx(2 * last)
    assert rates["opacities"] == before["opacities"]
    for name in ("scales", "quats", "sh0", "shN"):
        assert rates[name] == pytest.approx(faster * before[name])
    assert learning_rates(short, 2.0, 0.0)["means"] == learning_rates(plain, 2.0, 0.0)["means"]


def test_means_move_in_units_of_the_reach_in_short_runs() -> None:
    """Where 3DGS is asked for, and of photos that a codec alone spoiled, in units of the extent."""

    def times(iterations: int, reach: float, faster_rates: bool = True) -> list[float]:
        config = TrainConfig(iterations=iterations, faster_rates=faster_rates)
        pairs = [(learning_rates(config, 2.0, p, r) for r in (reach, None)) for p in (0.0, 1.0)]
        return [mine["means"] / other["means"] for mine, other in pairs]

    assert times(600, 8.0) == pytest.approx([4.0, 4.0])
    assert times(600, 200.0) == pytest.approx([50**0.6, 50**0.6])
    assert times(30_000, 8.0) == times(600, 8.0, faster_rates=False) == times(600, 1.0) == [1.0, 1.0]
    scene = tiny_scene()
    far = replace(scene, points=scene.points + 100 * scene.train[0].camera.viewmat[2, :3].astype(np.float32))
    assert far.reach > 9 * far.extent

    def rate(method: str, formation: str) -> float:
        config = tiny_config(600, method=method, hqgs=HQGSConfig(formation=formation))
        trainer = Trainer(far, config)
        trainer.step()
        groups = {group["name"]: group["lr"] for group in trainer.state.optimizer.param_groups}
        return groups["means"] / learning_rates(trainer.config, far.extent, 1 / 600)["means"]

    for formation in ("none", "noise:10", "blur:1"):
        assert rate("hqgs", formation) == pytest.approx(min(50**0.6, far.reach / far.extent))
    assert rate("hqgs", "jpeg:10") == rate("3dgs", "none") == pytest.approx(1.0)


def test_methods_of_our_own_have_them_unless_asked_not_to() -> None:
    def faster(method: str, asked: bool | None) -> bool | None:
        return Trainer(tiny_scene(), tiny_config(method=method, faster_rates=asked)).config.faster_rates

    assert [faster(method, None) for method in ("auto", "hqgs", "3dgs", "srgs")] == [True, True, None, None]
    assert not faster("auto", False)
    assert faster("3dgs", True)
    told = [tiny_config(method="hqgs", hqgs=HQGSConfig(formation=f)) for f in ("jpeg:10", "noise:9+jpeg:10")]
    assert [Trainer(tiny_scene(), config).config.faster_rates for config in told] == [False, True]


# --- the example of a method ---


def test_the_example_trains_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, method = tiny_scene(), Tinted()
    view = scene.train[0]
    render = torch.full((16, 24, 3), 0.25)
    expected = np.abs(0.25 - view.image / 255).mean()
    assert loss_of(method, render, view).item() == pytest.approx(expected, rel=1e-6)
    install(monkeypatch, "tinted", method)
    trainer = Trainer(scene, tiny_config(method="tinted"))
    gaussians = trainer.gaussians
    method.modulate(gaussians).sh0.sum().backward()
    assert torch.equal(method.tint.grad, torch.full((3,), 40.0))  # type: ignore[arg-type]
    trainer.step()
    np.testing.assert_allclose(method.tint.detach().abs().numpy(), 0.01, rtol=1e-4)  # Adam's first step


def test_the_example_resumes_with_the_same_bits(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install(monkeypatch, "tinted", lambda scene, config, inspector: Tinted())
    assert_stopped_alike(lambda: Trainer(tiny_scene(), tiny_config(method="tinted")), tmp_path, 17)


def test_a_small_render_is_the_full_one_made_smaller() -> None:
    """One Gaussian of 0.6 to 1.5 px, at places within a pixel: with the filter of its own size it is not."""
    K = np.array([[64.0, 0.0, 32.0], [0.0, 64.0, 32.0], [0.0, 0.0, 1.0]])
    half = np.diag([0.5, 0.5, 1.0]) @ K
    errors = {True: 0.0, False: 0.0}
    for k, sigma in enumerate((0.6, 0.8, 1.1, 1.5)):
        gaussian = Gaussians(
            means=torch.tensor([[0.013 * k, 0.007 * k, 1.0]]),
            scales=torch.full((1, 3), math.log(sigma / 64)),
            quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            opacities=torch.tensor([2.0]),
            sh0=torch.ones(1, 1, 3),
            shN=torch.zeros(1, 0, 3),
        )

        def render(size: int, K: np.ndarray, eps2d: float, of: Gaussians = gaussian) -> torch.Tensor:
            return render_view(of, Camera(size, size, K, np.eye(4)), 0, (0.0, 0.0, 0.0), eps2d)[0]

        full = render(64, K, low_pass(False)).reshape(32, 2, 32, 2, 3).mean(dim=(1, 3))
        for coarse in errors:
            errors[coarse] += float((render(32, half, low_pass(coarse)) - full).square().sum())
    assert low_pass(False) == 0.3
    assert errors[True] < errors[False] / 4
