"""Few photos: opacities decay and Gaussians drop out in training."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from planned import run_config
from run_state import run_until
from tiny_scene import tiny_config, tiny_scene

from hqgs.model.gaussians import Gaussians
from hqgs.training.config import TrainConfig
from hqgs.training.methods.base import Method
from hqgs.training.overfitting import DROPPED, OPAQUE, decay_opacities, with_dropout
from hqgs.training.plan import Facts
from hqgs.training.rules import DECAY, DROPOUT, MANY_PHOTOS, plan_run
from hqgs.training.trainer import Trainer


@pytest.mark.parametrize("share", [1e-4, 0.005, 0.5])
def test_decay_multiplies_opacities(share: float) -> None:
    logits = torch.tensor([-40.0, -5.0, 0.0, 3.0, 12.0, 40.0, 90.0])
    wanted = [(1 - share) / (1 + math.exp(-x)) for x in logits.tolist()]
    decay_opacities(logits, share)
    assert torch.isfinite(logits).all()
    got = 1 / (1 + np.exp(-logits.double().numpy()))
    np.testing.assert_allclose(got, wanted, rtol=2e-5)


def gaussians(n: int) -> Gaussians:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (n, 3)).astype(np.float32)
    made = Gaussians.from_points(points, np.full((n, 3), 128, np.uint8), 1)
    return replace(made, opacities=torch.from_numpy(rng.uniform(-3, 3, n).astype(np.float32)))


def test_dropout_leaves_out_a_share_and_keeps_the_mean_opacity() -> None:
    made, share = gaussians(20_000), 0.2
    opacities = torch.logit(torch.sigmoid(made.opacities).clamp(max=0.5)).requires_grad_()
    some = with_dropout(replace(made, opacities=opacities), share, 0, 7)
    dropped = some.opacities == DROPPED
    assert abs(float(dropped.float().mean()) - share) < 0.01
    mean = float(some.activated_opacities().detach().mean())
    assert mean == pytest.approx(float(torch.sigmoid(opacities.detach()).mean()), rel=0.02)
    some.opacities.sum().backward()
    assert opacities.grad is not None
    assert (opacities.grad[dropped] == 0).all()
    assert (opacities.grad[~dropped] > 0).all()
    again = with_dropout(replace(made, opacities=opacities), share, 0, 7)
    assert torch.equal(again.opacities, some.opacities)
    assert not torch.equal(with_dropout(made, share, 0, 8).opacities == DROPPED, dropped)
    assert with_dropout(made, 0.0, 0, 7) is made
    opaque = with_dropout(replace(made, opacities=torch.full_like(made.opacities, 9.0)), share, 0, 7)
    assert float(opaque.activated_opacities().max()) == pytest.approx(OPAQUE, rel=1e-5)


def test_dropout_of_what_has_decayed_to_nothing_has_gradients() -> None:
    made = gaussians(7)
    opacities = torch.tensor([-50.0, -87.0, -88.0, -95.0, -103.0, -104.0, -110.0], requires_grad=True)
    some = with_dropout(replace(made, opacities=opacities), 0.2, 0, 7)
    assert torch.isfinite(some.opacities).all()
    some.opacities.sum().backward()
    assert opacities.grad is not None
    assert torch.isfinite(opacities.grad).all()


def test_dropout_leaves_open_how_the_rest_is_seen() -> None:
    made = gaussians(40)
    made.antialiased = True
    assert with_dropout(made, 0.2, 0, 7).antialiased


def facts(photos: int, agreed: float | None = None) -> Facts:
    return Facts(photos, 10_000, 100, 50, True, agreed, as_photographed=True, sizes=((100, 100),) * photos)


@pytest.mark.parametrize(
    ("photos", "agreed", "decay", "dropout"),
    [
        (3, None, DECAY, DROPOUT),
        (12, None, DECAY, None),
        (23, 0.72, DECAY, None),
        (23, None, DECAY, None),
        (17, 0.91, None, None),
        (62, 0.7, DECAY / 2, None),  # as much in a look at all photos as of 31
        (62, 0.85, None, None),
        (62, None, None, None),
    ],
)
def test_the_plan_asks_for_decay_and_dropout_where_photos_are_few(
    photos: int, agreed: float | None, decay: float | None, dropout: float | None
) -> None:
    asked = run_config(iterations=1000, method="hqgs", formation="none")
    plan = plan_run(facts(photos, agreed), None, asked)
    assert (plan.settings.opacity_decay, plan.settings.dropout) == (decay, dropout)
    row = next(row for row in plan.rows if row.what == "opacity decay")
    assert f"{photos} photos" in row.evidence
    assert "2410.18822" in row.rule
    off = plan_run(facts(photos, agreed), None, replace(asked, opacity_decay=0.0, dropout=0.0))
    assert (off.settings.opacity_decay, off.settings.dropout) == (0.0, 0.0)
    plain = plan_run(facts(photos, agreed), None, run_config(iterations=1000, method="3dgs"))
    assert (plain.settings.opacity_decay, plain.settings.dropout) == (None, None)


@pytest.mark.parametrize(
    ("photos", "agreed", "decay"),
    [(3, None, DECAY), (23, 0.72, DECAY), (17, 0.91, DECAY), (62, 0.95, DECAY / 2)],
)
def test_degraded_photos_are_kept_from_being_learned_by_heart_too(
    photos: int, agreed: float | None, decay: float | None
) -> None:
    asked = run_config(iterations=1000, method="hqgs", formation="noise:12")
    plan = plan_run(facts(photos, agreed), None, asked)
    assert (plan.settings.opacity_decay, plan.settings.dropout) == (decay, None)
    assert plan.found_back == (photos <= MANY_PHOTOS)
    if decay is not None:
        assert float(next(r.value for r in plan.rows if r.what == "opacity decay").split()[0]) == decay


@pytest.mark.parametrize(
    ("formation", "photos", "agreed", "decay"),
    [
        ("blur:2", 23, 0.86, None),  # what blur took away fades, as only few pixels hold it up
        ("lowres:4+shake", 23, 0.86, None),
        ("lowres:4", 23, 0.84, DECAY),
        ("blur:2", 12, 0.88, DECAY),
        ("blur:2+noise:12", 23, 0.86, DECAY),
        ("lowres:2+jpeg:60", 23, 0.86, DECAY),
        ("shake", 23, 0.86, DECAY),
    ],
)
def test_fine_detail_that_all_photos_lost_decays_only_where_they_disagree(
    formation: str, photos: int, agreed: float, decay: float | None
) -> None:
    asked = run_config(iterations=1000, method="hqgs", formation=formation)
    assert plan_run(facts(photos, agreed), None, asked).settings.opacity_decay == decay


@pytest.mark.parametrize(
    ("photos", "points", "most"),
    [
        (8, 400, 16_000),  # 40 for each point
        (8, 20, 8 * 10_000 // 50),  # or one for 50 pixels
        (12, 1_000_000, None),
        (13, 400, None),
    ],
)
def test_growth_of_few_photos_is_bounded_by_what_they_agree_on(
    photos: int, points: int, most: int | None
) -> None:
    asked = run_config(iterations=1000, method="hqgs", formation="none")
    known = replace(facts(photos), pixels=photos * 10_000, points=points, found=True)
    given = asked.densify.max_gaussians
    plan = plan_run(known, None, asked)
    assert plan.settings.densify.max_gaussians == (most or given)
    exposed = plan_run(known, None, run_config(iterations=1000, method="hqgs", formation="exposure"))
    assert exposed.settings.densify.max_gaussians == (most or given)
    told = plan_run(replace(known, found=False), None, asked)  # by all photos of a capture, say
    assert told.settings.densify.max_gaussians == given
    less = replace(asked, densify=replace(asked.densify, max_gaussians=500))
    assert plan_run(known, None, less).settings.densify.max_gaussians == 500
    plain = plan_run(known, None, run_config(iterations=1000, method="3dgs"))
    assert plain.settings.densify.max_gaussians == given


def test_a_share_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"opacity_decay is 1\.0, wanted at least 0 and below 1"):
        TrainConfig(opacity_decay=1.0)
    with pytest.raises(ValueError, match=r"dropout is -0\.1"):
        TrainConfig(dropout=-0.1)


@pytest.mark.parametrize("left", [1.0, 2.0**-9, 2.0**-60])
def test_a_step_decays_what_it_trains_once_for_each_view_as_the_rates_do(
    left: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise halves the rates of a long run to nearly nothing; its scene must not fade by decay."""
    monkeypatch.setattr(Method, "rate_left", left)

    def after_a_step(decay: float, batch: int) -> torch.Tensor:
        config = replace(
            tiny_config(12, method="3dgs", batch=batch), lr_opacities=1e-12, opacity_decay=decay, dropout=0.0
        )
        trainer = Trainer(tiny_scene(), config)
        trainer.step()
        return trainer.gaussians.activated_opacities().detach()

    for batch in (1, 3):
        ratio = after_a_step(0.1, batch) / after_a_step(0.0, batch)
        wanted = (1 - 0.1 * left) ** batch
        torch.testing.assert_close(ratio, torch.full_like(ratio, wanted), rtol=1e-5, atol=0)


def test_more_iterations_end_better_where_photos_are_few() -> None:
    def at_the_end(iterations: int) -> float:
        config = run_config(iterations=iterations, method="hqgs", formation="none")
        trainer = run_until(Trainer(tiny_scene(4), config))
        trainer.evaluate()
        found = trainer.history[-1]["psnr"]
        assert found is not None
        return found

    short, longer, long = map(at_the_end, (40, 120, 360))
    assert short + 1 < longer
    assert longer + 1 < long
