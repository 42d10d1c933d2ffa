"""The training loop: that it learns, its schedules, its guards, and that no thread count changes a bit."""

from __future__ import annotations

import json
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_method import Tinted, install
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

from benchmarks.scenes.room.scene import embedded_scene
from hqgs.base.files import CHECKPOINT, PLY
from hqgs.base.interrupt import ENDINGS
from hqgs.base.stages import Stage
from hqgs.diagnosis.scene import Inspector
from hqgs.evaluation import held_out
from hqgs.model.gaussians import Gaussians
from hqgs.pipeline import open_run, run_to_end, train
from hqgs.scene.scene import Scene, View
from hqgs.training.config import DensifyConfig, TrainConfig, check_method
from hqgs.training.guard import MAX_SKIPPED_IN_A_ROW
from hqgs.training.methods.base import Target, ThreeDGS, photo_tensors
from hqgs.training.trainer import Trainer, TrainingError

ONLY_TRAIN = DensifyConfig(stop=0)


@dataclass(frozen=True)
class Named(Target):
    name: str


class Probe(Tinted):
    """A method whose loss can be replaced at chosen steps."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = 0
        self.at: dict[int, Any] = {}  # step -> function of the loss
        self.seen: list[str] = []

    def prepare(self, view: View) -> Named:
        return Named(*photo_tensors(view), view.name)

    def loss(self, image: Tensor, target: Any) -> Tensor:
        self.steps += 1
        self.seen.append(target.name)
        assert torch.get_num_threads() == 1  # sums in a loss depend on it
        return self.at.get(self.steps, lambda loss: loss)(ThreeDGS.loss(self, image, target))


@pytest.fixture
def probe(monkeypatch: pytest.MonkeyPatch) -> Probe:
    method = Probe()
    install(monkeypatch, "probe", method)
    return method


def steps(trainer: Trainer, count: int) -> list[float]:
    """The losses of so many steps."""
    return [trainer.step().loss for _ in range(count)]


def bits(trainer: Trainer) -> dict[str, bytes]:
    return {name: t.detach().numpy().tobytes() for name, t in trainer.gaussians.named().items()}


def test_held_out_views_get_better() -> None:
    trainer = Trainer(tiny_scene(num_points=80), tiny_config(150, densify=ONLY_TRAIN))
    trainer.evaluate()
    losses = steps(trainer, 150)
    trainer.evaluate()
    first, last = trainer.history
    assert (last["psnr"] or 0) > (first["psnr"] or np.inf) + 6
    assert (last["ssim"] or 0) > (first["ssim"] or np.inf) + 0.2
    assert np.mean(losses[-10:]) < 0.4 * np.mean(losses[:10])


def test_everything_is_written(tmp_path: Path) -> None:
    result = train(tiny_scene(), config=tiny_config(), out=tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["iterations"] == result.iterations == 30
    assert report["gaussians"] == len(Gaussians.load(tmp_path / PLY))
    assert [h["iteration"] for h in report["history"]] == [10, 20, 30]
    assert report["history"][-1]["psnr"] == pytest.approx(report["metrics"]["mean"]["psnr"], abs=1e-9)
    assert report["config"]["densify"]["reset_every"] == 12
    assert report["seconds"] >= report["history"][-1]["seconds"] > 0
    assert report["left_out"] == []
    names = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {
        ".lock", CHECKPOINT, PLY, "config.json", "report.json", "comparison/view0.png",
        "cameras.json", "report.html", *(f"photos/0000{k}.jpg" for k in range(6)),
    }  # fmt: skip


def test_a_scene_without_held_out_views(tmp_path: Path) -> None:
    s = tiny_scene()
    scene = Scene(s.name, s.train, [], s.points, s.point_colors, s.source)
    result = train(scene, config=tiny_config(), out=tmp_path)
    assert result.history[-1]["psnr"] is None
    assert "no photo is held out to measure with" in [item.why for item in result.left_out]


def test_an_epoch_visits_every_view_once_in_an_order_of_its_own(probe: Probe) -> None:
    trainer = Trainer(tiny_scene(), tiny_config(method="probe"))
    steps(trainer, 20)
    epochs = [probe.seen[i : i + 5] for i in range(0, 20, 5)]
    assert all(sorted(epoch) == [f"view{i}.png" for i in range(1, 6)] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_the_learning_rates_of_3dgs() -> None:
    scene = tiny_scene()
    trainer = Trainer(scene, tiny_config(20, densify=ONLY_TRAIN))
    rates: list[dict[str, float]] = []
    for _ in range(20):
        trainer.step()
        rates.append({g["name"]: g["lr"] for g in trainer.state.optimizer.param_groups})
    centers = np.stack([view.camera.center for view in scene.train])
    extent = 1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert rates[-1]["means"] == pytest.approx(1.6e-6 * extent)
    assert rates[9]["means"] == pytest.approx(1.6e-5 * extent)  # half way in log space
    assert rates[0]["means"] == pytest.approx(1.6e-4 * extent * 0.01 ** (1 / 20))
    rest = {name: rate for name, rate in rates[5].items() if name != "means"}
    assert rest == {"scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}


def test_evaluation_takes_no_training_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def slow_ssim(*images: Any) -> float:
        time.sleep(0.3)
        return 0.5

    monkeypatch.setattr(held_out, "ssim", slow_ssim)
    trainer = Trainer(tiny_scene(), tiny_config())
    trainer.step()
    before = trainer.seconds
    trainer.evaluate()
    trainer.evaluate()  # once per iteration
    assert trainer.seconds == before
    assert [entry["seconds"] for entry in trainer.history] == [before]


def test_seeds_matter() -> None:
    found = []
    for seed in (0, 0, 1):
        trainer = Trainer(tiny_scene(), tiny_config(seed=seed))
        steps(trainer, 12)
        found.append(bits(trainer))
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("only_the_gradient", [False, True])
def test_a_step_that_is_not_finite_is_skipped_and_counted(
    probe: Probe, bad: float, only_the_gradient: bool
) -> None:
    class BadGradient(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Tensor) -> Tensor:  # type: ignore[override]
            return x.clone()

        @staticmethod
        def backward(ctx: Any, v: Tensor) -> Tensor:  # type: ignore[override]
            return v * bad

    probe.at[3] = BadGradient.apply if only_the_gradient else lambda loss: loss * bad
    trainer = Trainer(tiny_scene(), tiny_config(method="probe"))
    trainer.step()
    trainer.step()
    before = bits(trainer)
    trainer.step()
    assert bits(trainer) == before
    assert trainer.state.guard.skipped == 1
    trainer.step()
    assert bits(trainer) != before
    assert trainer.state.guard.skipped == 1
    assert all(bool(torch.isfinite(t).all()) for t in trainer.gaussians.named().values())


def test_a_run_that_stays_not_finite_ends_with_the_reason(probe: Probe) -> None:
    probe.at = {step: lambda loss: loss * torch.nan for step in range(4, 100)}
    trainer = Trainer(tiny_scene(), tiny_config(100, method="probe", densify=ONLY_TRAIN))
    expected = (
        f"NaN or Inf in {MAX_SKIPPED_IN_A_ROW} steps in a row, up to iteration {MAX_SKIPPED_IN_A_ROW + 3}"
    )
    with pytest.raises(TrainingError, match=expected):
        steps(trainer, 100)


def test_no_gaussian_left_ends_with_the_reason() -> None:
    densify = DensifyConfig(start=0, every=5, prune_opacity=0.9)
    trainer = Trainer(tiny_scene(), tiny_config(densify=densify))
    with pytest.raises(TrainingError, match="no Gaussians are left at iteration 5"):
        steps(trainer, 10)


def test_what_is_far_away_survives_the_opacity_resets(tmp_path: Path) -> None:
    # Photos of a room, taken 0.9 apart and 5 away from what they show: pruning by size that goes by the
    # cameras' extent takes 20 dB here, and takes them again in each round.
    scene = embedded_scene(tmp_path, 48, 36)
    assert scene.reach > 5 * scene.extent
    densify = DensifyConfig(start=50, stop=400, every=50, reset_every=200, max_gaussians=5_000)
    trainer = Trainer(
        scene, TrainConfig(iterations=400, method="3dgs", leave_out=(), sh_degree=0, densify=densify)
    )
    while trainer.iteration < 400:
        if trainer.step() and trainer.iteration in (150, 200, 399):
            trainer.evaluate()
    before, at_reset, after = (entry["psnr"] or np.nan for entry in trainer.history)
    assert before > 20
    assert at_reset > before  # what is seen at a reset is the scene before it
    assert after > before - 1.0


def test_a_view_that_sees_nothing_is_no_error() -> None:
    scene = tiny_scene()
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])  # looks away from the points
    cameras = [type(v.camera)(v.camera.width, v.camera.height, v.camera.K, behind) for v in scene.train]
    views = [View(v.name, c, v.image) for v, c in zip(scene.train, cameras, strict=True)]
    away = Scene("away", views, [], scene.points, scene.point_colors, "test")
    trainer = Trainer(away, tiny_config())
    before = bits(trainer)
    step = trainer.step()
    assert not step.render.any()
    assert bits(trainer) == before
    assert trainer.state.densifier.count.sum() == 0
    assert trainer.state.guard.skipped == 0


def test_a_method_trains_and_keeps_tensors_of_its_own(probe: Probe, tmp_path: Path) -> None:
    config = tiny_config(method="probe")
    with open_run(tiny_scene(), config, tmp_path) as trainer:
        run_to_end(trainer, tmp_path)
    trained = probe.tint.detach().clone()
    assert trained.abs().max() > 0.01
    # The PLY holds what is rasterized.
    shown = trainer.gaussians.sh0.detach() + trained
    assert torch.equal(Gaussians.load(tmp_path / PLY).sh0, shown)
    moments = trainer.state.optimizer.state[probe.tint]["exp_avg"].clone()
    with torch.no_grad():
        probe.tint.zero_()
    with open_run(tiny_scene(), config, tmp_path, resume=True) as again:
        assert torch.equal(probe.tint, trained)
        assert torch.equal(again.state.optimizer.state[probe.tint]["exp_avg"], moments)


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_run_with_everything_written(
    probe: Probe, tmp_path: Path, ending: signal.Signals
) -> None:
    def interrupt(loss: Tensor) -> Tensor:
        signal.raise_signal(ending)
        return loss

    handlers = [signal.getsignal(number) or signal.SIG_DFL for number in ENDINGS]  # None: pycolmap's
    probe.at[17] = interrupt
    config = tiny_config(method="probe")
    result = train(tiny_scene(), config=config, out=tmp_path)
    assert [signal.getsignal(number) for number in ENDINGS] == handlers
    assert result.iterations == 17
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["left_out"] == [{"what": "iterations 18 to 30", "why": "the run was stopped"}]
    assert [h["iteration"] for h in report["history"]] == [10, 17]
    assert (tmp_path / PLY).exists()
    assert train(tiny_scene(), config=config, out=tmp_path, resume=True).iterations == 30


def test_a_second_ctrl_c_stops_at_once(probe: Probe, tmp_path: Path) -> None:
    def interrupt_twice(loss: Tensor) -> Tensor:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        return loss

    probe.at[17] = interrupt_twice
    with pytest.raises(KeyboardInterrupt):
        train(tiny_scene(), config=tiny_config(method="probe"), out=tmp_path)
    assert not (tmp_path / "report.json").exists()
    with open_run(tiny_scene(), tiny_config(method="probe"), tmp_path, resume=True) as trainer:
        assert trainer.iteration == 15  # the last regular checkpoint


def test_scenes_that_cannot_be_trained_are_refused() -> None:
    s, asked = tiny_scene(), list[Stage]()
    few = TrainConfig(densify=DensifyConfig(max_gaussians=39))
    with pytest.raises(ValueError, match="max_gaussians is 39, but the scene starts with 40 points"):
        Trainer(s, few, Inspector(asked.append))
    assert not asked  # before anybody looks at the photos
    with pytest.raises(ValueError, match="scene 'tiny' has no training views"):
        Trainer(Scene(s.name, [], s.test, s.points, s.point_colors, s.source), tiny_config())
    view = View("odd.png", s.train[0].camera, s.train[0].image[:-1])
    with pytest.raises(ValueError, match=r"view 'odd.png': the image is uint8 \[15, 24, 3\].*\[16, 24, 3\]"):
        Trainer(Scene(s.name, [view], [], s.points, s.point_colors, s.source), tiny_config())


def test_a_method_may_still_the_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    """With none of the rates left nothing moves; with a quarter the first step is a quarter as long."""

    def moved(left: float) -> dict[str, Tensor]:
        monkeypatch.setattr(ThreeDGS, "rate_left", left)
        trainer = Trainer(tiny_scene(), tiny_config(10, method="3dgs"))
        before = {name: tensor.detach().clone() for name, tensor in trainer.gaussians.named().items()}
        trainer.step()
        return {name: tensor.detach() - before[name] for name, tensor in trainer.gaussians.named().items()}

    whole, quarter = moved(1.0), moved(0.25)
    assert not any(step.any() for step in moved(0.0).values())
    for name in ("means", "scales", "quats", "opacities", "sh0"):
        assert whole[name].any()
        torch.testing.assert_close(quarter[name], whole[name] / 4, rtol=0.01, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [("iterations", 0), ("seed", -1), ("sh_degree", 4), ("lr_means", 0.0), ("lr_shN", torch.nan)],
)
def test_bad_settings_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}"):
        TrainConfig(**{field: value})  # type: ignore[arg-type]


def test_an_unknown_method_is_refused_with_the_names() -> None:
    with pytest.raises(ValueError, match="unknown method '4dgs'; the methods are: 3dgs"):
        TrainConfig(method="4dgs")
    with pytest.raises(ValueError, match="unknown method '4dgs'"):
        check_method("4dgs")


def test_what_is_due_goes_by_the_length() -> None:
    long, short, shortest = (TrainConfig(iterations=n).due for n in (30_000, 2_100, 100))
    assert (long.sh_interval, long.eval_every, long.checkpoint_every) == (1_000, 3_000, 1_000)
    assert (short.sh_interval, short.eval_every, short.checkpoint_every) == (300, 210, 210)
    assert (shortest.sh_interval, shortest.eval_every, shortest.checkpoint_every) == (14, 50, 10)
    assert TrainConfig(iterations=2_100).fitted().due == short
