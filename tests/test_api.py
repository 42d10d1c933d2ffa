"""`import hqgs`: the defaults of the command line, typed results, nothing written without a folder."""

from __future__ import annotations

import inspect
import json
import signal
from dataclasses import asdict, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from planned import run_config
from tiny_scene import DEPTH, tiny_config, tiny_scene

import hqgs
from hqgs.base.files import CHECKPOINT, PLY
from hqgs.base.stages import Stage
from hqgs.cli import main as cli
from hqgs.evaluation.records import read_report
from hqgs.scene import source
from hqgs.scene.options import LoadOptions
from hqgs.training.config import AUTOMATIC, PART, TrainConfig, TrainOptions
from hqgs.training.prepare import facts_of
from hqgs.training.rules import plan_run


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working folder of its own, and the tiny scene in place of the embedded one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(source, "embedded_scene", lambda *_: tiny_scene())


def a_model() -> hqgs.Gaussians:
    scene = tiny_scene()
    generator = torch.Generator().manual_seed(1)
    model = hqgs.Gaussians.from_points(scene.points, scene.point_colors)
    return replace(model, shN=0.2 * torch.randn(model.shN.shape, generator=generator))


def test_the_command_line_and_python_make_the_same_run(tmp_path: Path) -> None:
    command = ["train", "embedded", "--out", "cli", "--iterations", "12"]
    assert cli.main(command) == 0
    run = hqgs.train(hqgs.load("embedded"), out="api", iterations=12)
    written = json.loads((tmp_path / "cli" / "report.json").read_text())
    assert written["config"] == json.loads(json.dumps(run.report["config"]))
    assert (tmp_path / "cli" / PLY).read_bytes() == (tmp_path / "api" / PLY).read_bytes()
    assert run.out == Path("api")


def test_a_bare_configuration_has_the_defaults_too() -> None:
    asked = run_config()
    assert replace(asked, leave_out=AUTOMATIC) == hqgs.TrainConfig()
    assert (asked.method, asked.iterations) == ("auto", 30_000)
    assert set(asked.leave_out) == {"photos", "growth", "iterations"}
    assert "iterations" not in run_config(iterations=30_000).leave_out
    assert run_config(leave_out="none").leave_out == ()


def test_what_a_user_says_of_a_run_has_the_same_names_and_defaults_everywhere() -> None:
    train = inspect.signature(hqgs.train).parameters
    for option in fields(TrainOptions):
        assert train[option.name].default is None
        part = PART.get(option.name)
        kind = TrainConfig if part is None else type(getattr(TrainConfig(), part))
        assert option.name in {field.name for field in fields(kind)}
    assert train["iterations"].annotation == int | None
    with pytest.raises(TypeError, match="unexpected keyword argument 'iteration'"):
        hqgs.train(tiny_scene(), iteration=3)  # pyright: ignore[reportCallIssue]
    load = inspect.signature(hqgs.load).parameters
    assert {*load} - {field.name for field in fields(LoadOptions)} == {"cache", "points", "on_stage"}
    assert load["up"].annotation == tuple[float, float, float] | None


def test_without_a_folder_nothing_is_written(tmp_path: Path) -> None:
    run = hqgs.train(tiny_scene(), config=tiny_config())
    assert list(tmp_path.iterdir()) == []
    assert (run.iterations, run.length, run.finished, run.out) == (30, 30, True, None)
    assert run.report["scene_bytes"] is None
    assert [view["picture"] for view in run.report["metrics"]["views"]] == [None]
    assert run.history[-1]["psnr"] == pytest.approx(run.report["metrics"]["mean"]["psnr"], abs=1e-9)
    with torch.no_grad():
        shown = run.model.render(tiny_scene().test[0].camera)
    np.testing.assert_array_equal(shown.numpy(), run.views[0].render)
    assert not run.model.means.requires_grad


def test_with_a_folder_the_report_is_the_one_that_is_returned(tmp_path: Path) -> None:
    run = hqgs.train(tiny_scene(), config=tiny_config(), out=tmp_path / "run")
    assert read_report(tmp_path / "run" / "report.json") == json.loads(json.dumps(run.report))
    back = hqgs.Gaussians.load(tmp_path / "run")
    for name, tensor in run.model.named().items():
        assert torch.equal(back.named()[name], tensor), name


def test_a_run_is_not_lost_by_a_second_call(tmp_path: Path) -> None:
    out = tmp_path / "run"
    hqgs.train(tiny_scene(), config=tiny_config(10), out=out)
    before = (out / CHECKPOINT).read_bytes()
    with pytest.raises(FileExistsError, match="holds a run; resume=True continues it, overwrite=True"):
        hqgs.train(tiny_scene(), config=tiny_config(10), out=out)
    assert (out / CHECKPOINT).read_bytes() == before
    assert hqgs.train(tiny_scene(), config=tiny_config(10), out=out, resume=True).iterations == 10
    with pytest.raises(ValueError, match="resume continues the run, overwrite starts again"):
        hqgs.train(tiny_scene(), config=tiny_config(10), out=out, resume=True, overwrite=True)
    (out / "plan.json").write_text("{}")
    with pytest.raises(KeyboardInterrupt):  # a run that is killed leaves no scene beside others' cameras
        hqgs.train(tiny_scene(), config=tiny_config(11), out=out, overwrite=True, progress=_killed)
    left = {"config.json", "cameras.json", "photos", "comparison"}
    assert {path.name for path in out.iterdir() if not path.name.startswith(".")} <= left
    assert hqgs.train(tiny_scene(), config=tiny_config(11), out=out, overwrite=True).iterations == 11


def _killed(_: object) -> None:
    raise KeyboardInterrupt


def test_what_is_said_beside_a_configuration_goes_over_it() -> None:
    run = hqgs.train(tiny_scene(), config=tiny_config(3, seed=2), seed=3, max_gaussians=50)
    had = tiny_config(3, seed=3)
    had = replace(had, densify=replace(had.densify, max_gaussians=50))
    assert run.report["config"] == asdict(plan_run(facts_of(tiny_scene()), None, had).settings.fitted())


def test_wrong_settings_are_named() -> None:
    for wrong, message in (
        ({"method": "4dgs"}, "unknown method '4dgs'"),
        ({"leave_out": "colour"}, "unknown 'colour'"),
        ({"iterations": 0}, "iterations is 0"),
        ({"formation": "fog"}, "unknown degradation 'fog'"),
    ):
        with pytest.raises(ValueError, match=message):
            hqgs.train(tiny_scene(), **wrong)  # type: ignore[arg-type]


def test_progress_is_told_each_step() -> None:
    told: list[hqgs.Progress] = []
    run = hqgs.train(tiny_scene(), config=tiny_config(), progress=told.append)
    assert [now.iteration for now in told] == list(range(1, 31))
    assert {now.length for now in told} == {30}
    assert [now.iteration for now in told if now.evaluated is not None] == [10, 20, 30]
    assert [now.evaluated for now in told if now.evaluated is not None] == run.history
    last = told[-1]
    assert last.gaussians == len(run.model)
    view = next(view for view in tiny_scene().train if view.name == last.view)
    error = np.square(last.render.clip(0, 1) - view.image / 255.0).mean()
    assert last.psnr() == pytest.approx(-10 * np.log10(error), abs=1e-6)
    assert all(a.seconds <= b.seconds for a, b in pairwise(told))


def test_the_preparation_is_told() -> None:
    scene, stages = tiny_scene(), list[Stage]()
    seen = {view.name: np.arange(5) for view in scene.train}
    scene = replace(scene, points=scene.points[:5], point_colors=scene.point_colors[:5], seen=seen)
    hqgs.train(scene, config=tiny_config(2, method="hqgs"), on_stage=stages.append)
    counts = [(stage.what, stage.done, stage.total) for stage in stages]
    assert counts[:5] == [("photos diagnosed", k, 5) for k in range(1, 6)]
    assert counts[5:15] == [("first points, from photos", k, 10) for k in range(1, 11)]  # two looks at each
    assert [what for what, *_ in counts[15:]] == ["planned"]


def test_the_first_ctrl_c_returns_what_there_is() -> None:
    def stop(now: hqgs.Progress) -> None:
        if now.iteration == 7:
            signal.raise_signal(signal.SIGINT)

    run = hqgs.train(tiny_scene(), config=tiny_config(), progress=stop)
    assert (run.iterations, run.length, run.finished) == (7, 30, False)
    assert run.left_out[-1].what == "iterations 8 to 30"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_load_goes_through_the_stages_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[str, Any]] = []

    def reconstruct(scene: hqgs.Scene, keep: Path | None, on_stage: object) -> hqgs.Scene:
        calls.append(("sfm", keep))
        assert scene.train[0].image.dtype == np.float32  # the photos are degraded by then
        return scene

    def restored(scene: hqgs.Scene, weights: Path) -> hqgs.Scene:
        calls.append(("restore", weights))
        return scene

    monkeypatch.setattr(source, "sfm_scene", reconstruct)
    monkeypatch.setattr(source, "restore_scene", restored)
    monkeypatch.setattr(source, "check_weights", lambda weights: calls.append(("check", weights)))
    scene = hqgs.load("embedded", sfm=True, degrade="noise:25", seed=3, restore="w.pth", cache="kept")
    assert calls == [("check", "w.pth"), ("sfm", Path("kept/sfm")), ("restore", "w.pth")]
    by_hand = hqgs.degrade(tiny_scene(), "noise:25", seed=3)
    assert all(np.array_equal(a.image, b.image) for a, b in zip(scene.train, by_hand.train, strict=True))


def test_wrong_scenes_are_named() -> None:
    with pytest.raises(FileNotFoundError, match="there is no scene folder /no/such"):
        hqgs.load("/no/such")
    with pytest.raises(ValueError, match="downscale must be at least 1, got 0"):
        hqgs.load("embedded", downscale=0)
    with pytest.raises(ValueError, match="test_every is 5, but the built-in scene"):
        hqgs.load("embedded", test_every=5)
    with pytest.raises(ValueError, match="unknown degradation 'fog'"):
        hqgs.degrade(tiny_scene(), "fog")


def test_a_diagnosis_prints_a_table() -> None:
    text = str(hqgs.diagnose(tiny_scene()))
    assert all(view.name in text for view in tiny_scene().train)
    assert "\ntiny: " in text


@pytest.mark.parametrize("degree", [None, 0, 2])
def test_render_is_the_rasterizer_on_one_camera(degree: int | None) -> None:
    model, camera = a_model(), tiny_scene().test[0].camera
    image = model.render(camera, background=(0, 1, 3), sh_degree=degree)  # whole numbers will do
    wanted, _, _ = hqgs.rasterization(
        model.means,
        model.quats,
        model.scales.double().exp().float(),
        model.opacities.double().sigmoid().float(),
        torch.cat([model.sh0, model.shN], dim=1),
        torch.tensor(camera.viewmat)[None],
        torch.tensor(camera.K)[None],
        camera.width,
        camera.height,
        sh_degree=3 if degree is None else degree,
        backgrounds=torch.tensor([[0.0, 1.0, 3.0]]),
    )
    assert image.shape == (camera.height, camera.width, 3)
    assert torch.equal(image, wanted[0])
    assert image.max() > 1.5  # not clamped
    double = hqgs.Gaussians(**{name: tensor.double() for name, tensor in model.named().items()})
    assert double.render(camera, background=(0, 1, 3), sh_degree=degree).dtype == torch.float64


def test_render_passes_gradients_and_checks_its_arguments() -> None:
    model, camera = a_model(), tiny_scene().test[0].camera
    model.sh0.requires_grad_()
    model.render(camera).sum().backward()
    assert model.sh0.grad is not None
    assert model.sh0.grad.abs().sum() > 0
    with pytest.raises(ValueError, match=r"sh_degree is 4, wanted 0\.\.3"):
        model.render(camera, sh_degree=4)
    with pytest.raises(ValueError, match=r"background is .*, wanted three numbers"):
        model.render(camera, background=(0.0,))


def test_files_by_suffix(tmp_path: Path) -> None:
    model = a_model()
    assert repr(model) == "Gaussians(40, sh_degree=3)"
    assert (model.save("a.ply"), model.save("a.SPZ"), model.save("a.bin", "spz")) == (0, 0, 0)
    assert (tmp_path / "a.SPZ").read_bytes() == (tmp_path / "a.bin").read_bytes()
    assert torch.equal(hqgs.Gaussians.load("a.ply").shN, model.shN)
    for back in (hqgs.Gaussians.load("a.SPZ"), hqgs.Gaussians.load("a.bin", "spz")):
        torch.testing.assert_close(back.means, model.means, rtol=0, atol=1e-3 * DEPTH)
    model.means[3, 1] = torch.nan
    assert (model.save("b.ply"), model.save("b.spz")) == (1, 1)
    for call in (model.save, hqgs.Gaussians.load):
        with pytest.raises((ValueError, FileNotFoundError), match=r"b\.xyz"):
            call("b.xyz")
    with pytest.raises(ValueError, match=r"format is 'obj', wanted one of: ply, full\.ply, "):
        model.save("b.splat", "obj")
