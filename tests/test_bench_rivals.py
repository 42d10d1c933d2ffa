"""The rows of other methods in the benchmark `quality`: what each learns on a tiny scene, and their keys."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from benchmarks.measure import train
from benchmarks.protocol import Row, narrowed
from benchmarks.quality import deblur
from benchmarks.quality import run as quality
from benchmarks.quality.deblur import RivalRow
from benchmarks.study import Study, digest_of, grid
from hqgs.scene.scene import Scene, View
from hqgs.training.checkpoint import scene_fingerprint
from hqgs.training.config import DensifyConfig, TrainConfig
from tests.tiny_scene import DEPTH, HEIGHT, WIDTH, tiny_scene

SHAKES = (0.0, 0.6, 0.0, 0.9, 0.6)  # the ways of the cameras from left to right, world units: up to 6 px


def striped(view: View, moved: float) -> NDArray[np.float64]:
    """What a camera sees of stripes on the plane of the tiny scene that has gone to the right."""
    _, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    camera = view.camera
    x = camera.center[0] + moved + DEPTH * (columns - camera.K[0, 2]) / camera.K[0, 0]
    return np.repeat(0.5 + 0.4 * np.tanh(3 * np.sin(4 * x))[..., None], 3, axis=2)


def shaken_scene() -> Scene:
    """Shaken training photos, a sharp one to judge by."""

    def photo(view: View, way: float) -> View:
        seen = [striped(view, way * t) for t in np.linspace(-0.5, 0.5, 21)]
        return replace(view, image=np.mean(seen, axis=0).astype(np.float32))

    scene = tiny_scene(num_points=200)
    train = [photo(view, way) for view, way in zip(scene.train, SHAKES, strict=True)]
    return replace(scene, train=train, test=[photo(view, 0) for view in scene.test])


def config(iterations: int, **changes: Any) -> TrainConfig:
    still = DensifyConfig(start=10 * iterations, reset_every=10 * iterations)
    given: dict[str, Any] = {"method": "3dgs", "leave_out": (), "eval_every": iterations, "densify": still}
    return TrainConfig(iterations=iterations, **given | changes)


def test_paths_are_those_of_the_shaken_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"RATE": 0.02, "LAST_RATE": 0.002, "VIRTUAL": 5}.items():  # long ways, a short run
        monkeypatch.setattr(deblur, name, value)
    scene, settings = shaken_scene(), config(600)
    plain = train(scene, settings).trainer
    found = deblur.train_deblur(scene, settings).trainer
    assert plain.history[-1]["psnr"] is not None
    assert found.history[-1]["psnr"] is not None
    assert found.history[-1]["psnr"] > plain.history[-1]["psnr"] + 2
    for number, view in enumerate(scene.train):
        path = found.method.viewmats(number, view.camera).detach().numpy()  # type: ignore[attr-defined]
        seen = [(matrix @ [0, 0, DEPTH, 1])[0] for matrix in path]  # px would be 20 / 3 as many
        assert max(seen) - min(seen) == pytest.approx(SHAKES[number], abs=0.25)
        shown = -np.linalg.inv(view.camera.viewmat)[0, 3]
        assert np.mean(seen) == pytest.approx(shown, abs=0.05)


def test_same_seed_same_paths() -> None:
    def run(seed: int) -> list[torch.Tensor]:
        trainer = deblur.train_deblur(shaken_scene(), config(4, seed=seed)).trainer
        return [*trainer.gaussians.named().values(), *trainer.method.knots]  # type: ignore[attr-defined]

    first, same, other = run(0), run(0), run(1)
    assert all(torch.equal(a, b) for a, b in zip(first, same, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


def test_a_path_is_a_cubic_spline_about_the_pose() -> None:
    scene = tiny_scene()
    method, camera = deblur.Deblur(scene, config(1)), scene.train[0].camera
    knots = np.random.default_rng(0).normal(size=(deblur.KNOTS, 3))
    with torch.no_grad():
        method.knots[0][:] = torch.from_numpy(np.concatenate([np.zeros_like(knots), knots], axis=1))
    way = BSpline(np.arange(-3, 5.0), knots, 3)(np.linspace(0, 1, deblur.VIRTUAL))
    moved = method.viewmats(0, camera).detach().numpy()[:, :3, 3] - camera.viewmat[:3, 3]
    np.testing.assert_allclose(moved, scene.extent * (way - way.mean(axis=0)), atol=1e-12)


def test_growth_goes_by_the_sum_over_the_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a path that stands still it is the gradient of one render."""
    monkeypatch.setattr(deblur, "FIRST", 0.0)
    scene, settings = shaken_scene(), config(1, densify=DensifyConfig(start=10, stop=20))
    one, many = (run(scene, settings).trainer.state.densifier for run in (train, deblur.train_deblur))
    assert one.grad_sum.any()
    torch.testing.assert_close(many.grad_sum, one.grad_sum, rtol=1e-3, atol=1e-9)
    assert torch.equal(many.count, one.count)


def test_rows_are_measured_as_all_others(tmp_path: Path) -> None:
    rows = ["3dgs", "deblur"]
    protocol = narrowed(quality.PROTOCOLS["wild"], rows=rows, degradations=["none"], seeds=[0], iterations=5)
    args = argparse.Namespace(
        out=tmp_path, validate=False, sfm=False, fit_cameras=False, pictures=1, known=False, finished=False
    )
    bench = quality.Quality(Study(args, "quality", protocol, [tiny_scene()]))
    bench.study.train(bench.measure)
    assert bench.study.failures == {}
    assert bench.sheets() == []
    runs = bench.study.frame()
    assert list(runs["row"]) == rows
    assert runs[["psnr", "ssim", "seconds", "cpu_seconds", "render_ms"]].notna().to_numpy().all()
    assert len(list((tmp_path / "pictures").iterdir())) == 1


def test_digests_hold_the_form_of_a_rival_and_leave_the_others_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tiny_scene()
    protocol = narrowed(quality.PROTOCOLS["wild"], degradations=["none"], seeds=[0])
    cells = {cell.row.label: cell for cell in grid(protocol, [scene])}
    prints = scene_fingerprint(scene)
    keys = {label: digest_of(cell, prints) for label, cell in cells.items()}
    assert len(set(keys.values())) == len(keys) == 4
    for label in ("3dgs", "gains alone", "hqgs"):
        row = cells[label].row
        assert isinstance(row, RivalRow)
        assert row.more == Row(label).more == {}  # as before there were rivals
    (tmp_path / "deblur.py").write_text("another form", encoding="utf-8")
    monkeypatch.setattr(deblur, "__file__", str(tmp_path / "deblur.py"))
    for cell in grid(protocol, [scene]):
        same = digest_of(cell, prints) == keys[cell.row.label]
        assert same == (cell.row.label != "deblur")
