"""What a run leaves out by itself: each decision on a scene made for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from run_state import assert_stopped_alike, run_until
from tiny_scene import HEIGHT, WIDTH, tiny_config, tiny_scene

from hqgs.base.left_out import CORRECTION, DIAGNOSIS, PHOTO, LeftOut, format_left_out
from hqgs.base.ranks import ALONE
from hqgs.photos.pixels import to_uint8
from hqgs.pipeline import train
from hqgs.scene.scene import Scene
from hqgs.training import rules
from hqgs.training.config import DensifyConfig, HQGSConfig, TrainConfig, parse_leave_out
from hqgs.training.plan import left_out_of
from hqgs.training.schedule import smaller
from hqgs.training.trainer import Trainer

VIEWS = 13  # one is a test view; of twelve, one is held back
STILL = DensifyConfig(start=10_000, reset_every=10_000)


def run(scene: Scene, iterations: int, *items: str, **changes: object) -> Trainer:
    return run_until(Trainer(scene, tiny_config(iterations, leave_out=items, **changes)))


def test_the_items_by_name() -> None:
    assert parse_leave_out("auto") == ("photos", "growth")
    assert parse_leave_out("none") == ()
    assert parse_leave_out("growth, photos") == ("photos", "growth")
    with pytest.raises(ValueError, match="unknown 'colour'; wanted auto, none, or some of photos"):
        parse_leave_out("photos,colour")
    with pytest.raises(ValueError, match="unknown 'colour'"):
        TrainConfig(leave_out=("colour",))


def test_with_nothing_to_leave_out_all_photos_are_trained_at_full_size() -> None:
    trainer = Trainer(tiny_scene(VIEWS), tiny_config(24))
    seen = [trainer.step().view for _ in range(24)]
    assert {view.name for view in seen} == {view.name for view in trainer.scene.train}
    assert {view.camera.width for view in seen} == {WIDTH}
    assert left_out_of(trainer.state.rows) == []
    assert trainer.length == 24


def test_some_photos_are_held_back_until_growth_ends() -> None:
    trainer = Trainer(tiny_scene(VIEWS), tiny_config(60, leave_out=("iterations",)))
    names = [trainer.step().view.name for _ in range(60)]
    held = {trainer.scene.train[k].name for k in trainer.schedule.held}
    back = trainer.state.decisions.released
    assert back == trainer.config.due.stop
    assert len(held) == 1
    assert not held & set(names[:back])
    assert set(names[back:]) == {view.name for view in trainer.scene.train}


def test_few_photos_are_never_held_back() -> None:
    trainer = run(tiny_scene(9), 30, "iterations")
    assert trainer.schedule.held == ()
    assert left_out_of(trainer.state.rows) == []


def test_degraded_photos_have_a_budget_of_their_own() -> None:
    scene, items = tiny_scene(VIEWS), ("photos", "growth", "resolution", "iterations")
    noisy = tiny_config(30, method="hqgs", hqgs=HQGSConfig(formation="noise:20"), leave_out=items)
    assert set(Trainer(scene, noisy).config.leave_out) == {"photos", "iterations"}
    clean = replace(noisy, hqgs=HQGSConfig(formation="none"))
    assert set(Trainer(scene, clean).config.leave_out) == set(items) - {"resolution"}  # too small for that


def test_fine_gaussians_do_not_grow() -> None:
    everything, coarse = run(tiny_scene(), 30), run(tiny_scene(), 30, "growth")
    assert len(coarse.gaussians) < len(everything.gaussians)
    assert coarse.state.refused > 0
    told = [item.what for item in coarse.left_out()]
    assert f"{coarse.state.refused} splits of small Gaussians" in told


@pytest.mark.parametrize(
    ("items", "iterations", "interval"),
    [((), 6_000, 857), (("growth",), 6_000, 300), (("growth",), 3_000, 428), ((), 30_000, 1_000)],
)
def test_the_next_degree_comes_sooner_where_growth_is_left_out(
    items: tuple[str, ...], iterations: int, interval: int
) -> None:
    config = TrainConfig(iterations, "3dgs", leave_out=items)
    schedule = Trainer(tiny_scene(), config).schedule
    assert [schedule.degree(k) for k in (interval - 1, interval, 3 * interval - 1, 3 * interval)] == [
        0,
        1,
        2,
        3,
    ]


def test_the_first_part_is_trained_at_half_the_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rules, "SMALLEST_SIDE", 8)
    trainer = Trainer(tiny_scene(), tiny_config(20, leave_out=("resolution",)))
    shapes = [tuple(trainer.step().render.shape) for _ in range(20)]
    end = 12  # 60 %
    assert shapes == [(HEIGHT // 2, WIDTH // 2, 3)] * end + [(HEIGHT, WIDTH, 3)] * (20 - end)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_smaller_view_shows_the_same_in_the_mean(dtype: type) -> None:
    view = tiny_scene().train[0]
    image = view.image if dtype == np.uint8 else view.image.astype(np.float32) / 255
    small = smaller(replace(view, image=image))
    assert small.image.dtype == dtype
    assert small.image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    blocks = image.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).astype(np.float64).mean((1, 3))
    assert np.abs(small.image - blocks).max() <= (0.5 if dtype == np.uint8 else 1e-6)
    np.testing.assert_allclose(small.camera.K[:2], view.camera.K[:2] / 2)


def test_a_run_that_stops_improving_is_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hqgs.training.trainer.CHECKS", 10)
    monkeypatch.setattr("hqgs.training.trainer.PATIENCE", 40)
    still = replace(STILL, stop=2_000)
    config = tiny_config(3_000, leave_out=("iterations",), lr_means=1e-7, lr_means_final=1e-9, densify=still)
    trainer = Trainer(tiny_scene(VIEWS), config)
    rates = []
    while trainer.iteration < trainer.length:
        trainer.step()
        rates.append(next(g["lr"] for g in trainer.state.optimizer.param_groups if g["name"] == "means"))
    state = trainer.state.decisions
    assert trainer.iteration == state.length < 2_000
    assert state.released == pytest.approx(state.length / 1.5, abs=1)
    assert trainer.schedule.densification_end(state) == pytest.approx(1.25 * state.released, abs=1)
    assert rates[-1] == pytest.approx(trainer.scene.extent * 1e-9)
    assert all(b <= a for a, b in pairwise(rates))
    assert left_out_of(trainer.state.rows)[0].what == f"iterations {state.length + 1} to 3000"


def test_photos_of_which_masks_leave_nothing_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hqgs.training.trainer.CHECKS", 5)
    monkeypatch.setattr("hqgs.training.trainer.PATIENCE", 10)
    scene, config = tiny_scene(VIEWS), tiny_config(30, leave_out=("iterations",), densify=STILL)
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    (held,) = Trainer(scene, config).schedule.held
    views = [replace(view, mask=nothing) if k == held else view for k, view in enumerate(scene.train)]
    trainer = Trainer(replace(scene, train=views), config)
    others = [k for k in range(len(views)) if k != held]

    def psnr(numbers: Sequence[int]) -> float:
        return trainer.prepared.training_views.psnr(trainer.shown(), numbers, 0, False, ALONE)

    assert psnr(range(len(views))) == psnr(others)
    assert np.isnan(psnr([held]))
    assert run_until(trainer).length == 30
    assert left_out_of(trainer.state.rows) == []


def test_noise_that_black_and_white_cut_off_does_not_make_a_run_perfect() -> None:
    """Stored photos hold less noise than was added: what is left of an error would be below 0."""
    noise, scene = 30 / 255, tiny_scene(VIEWS)
    rng = np.random.default_rng(0)
    pure = {view.name: 0.06 + 0.6 * (rng.random((HEIGHT, WIDTH, 3)) > 0.4) for view in scene.train}
    noisy = [
        replace(view, image=to_uint8((pure[view.name] + rng.normal(0, noise, (HEIGHT, WIDTH, 3))).clip(0, 1)))
        for view in scene.train
    ]
    config = tiny_config(30, method="hqgs", hqgs=HQGSConfig(formation="noise:30"))
    training = Trainer(replace(scene, train=noisy), config).prepared.training_views
    for off, wanted in ((0.05, 26.0), (0.1, 20.0)):
        renders = {view.name: torch.from_numpy(pure[view.name] + off).float() for view in noisy}
        with patch.object(training, "taken", lambda _, k, *__: renders[noisy[k].name]):  # noqa: B023
            found = training.psnr(training, range(len(noisy)), 0, False, ALONE)  # type: ignore[arg-type]
        assert abs(found - wanted) < 1.5


def test_a_resumed_run_is_the_same_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rules, "SMALLEST_SIDE", 8)
    scene, config = tiny_scene(VIEWS), tiny_config(60, leave_out=("growth", "resolution"), sh_interval=6)
    assert_stopped_alike(lambda: Trainer(scene, config), tmp_path, 11, 31, 51)


def test_the_report_tells_what_was_left_out(tmp_path: Path) -> None:
    result = train(tiny_scene(VIEWS), config=tiny_config(leave_out=("growth",)), out=tmp_path)
    assert result.left_out[0].what.endswith("splits of small Gaussians")
    assert result.report["scene_bytes"] == (tmp_path / "scene.ply").stat().st_size


def test_the_table() -> None:
    assert format_left_out([]) == ""
    items = [LeftOut("a", "not needed"), LeftOut("bcd", "no use")]
    assert format_left_out(items) == "left out:\n  a    not needed\n  bcd  no use"
    table = format_left_out([LeftOut(f"{CORRECTION}blur", "sharp"), *items, LeftOut(f"{CORRECTION}jpeg", "")])
    *rest, last = table.splitlines()[1:]
    assert last.split(None, 1) == ["corrections", "not needed for blur, jpeg"]
    assert [row.split()[0] for row in rest] == ["a", "bcd"]


def test_the_table_begins_with_photos_and_has_five_lines() -> None:
    looks = [LeftOut(f"{DIAGNOSIS}{k} photos", "") for k in range(3)]
    items = [*looks, LeftOut("a", ""), *(LeftOut(f"{PHOTO}{k}.png", "blurred") for k in range(7))]
    lines = format_left_out(items).splitlines()[1:]
    first = "training photos: 7 0.png, 1.png, 2.png, 3.png, 4.png and 2 more: blurred"
    assert " ".join(lines[0].split()) == first
    assert [line.split()[0] for line in lines[1:]] == ["a", "diagnosis", "diagnosis", "diagnosis"]
    many = format_left_out([LeftOut(str(k), "") for k in range(9)]).splitlines()[1:]
    assert [" ".join(line.split()) for line in many[3:]] == ["3", "and 5 more the report has them all"]
