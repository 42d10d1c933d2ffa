"""Maps of trust: what photos say of the Gaussians, and what that says of a pixel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_ply import random_gaussians
from tiny_scene import tiny_scene

import hqgs
from hqgs.cli import main as cli
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.scene import Camera, Scene, View
from hqgs.show.trust import EMPTY, FLOOR, GOOD, _ause, _back, learn_trust, measure_trust


def solid() -> Gaussians:
    """Opaque Gaussians at the points of the tiny scene."""
    scene = tiny_scene()
    g = Gaussians.from_points(scene.points, scene.point_colors, 0)
    g.opacities[:] = 3.0
    return g


def as_run(folder: Path, g: Gaussians, wrong: torch.Tensor) -> Scene:
    """A run of these Gaussians, in whose photos those called `wrong`, bool [N], are brighter."""
    scene = tiny_scene()
    truth = g.like(g.named() | {"sh0": g.sh0 + wrong[:, None, None]})

    def photo(view: View) -> View:
        return replace(view, image=(255 * truth.render(view.camera).clamp(0, 1)).round().byte().numpy())

    shot = replace(scene, train=[*map(photo, scene.train)], test=[*map(photo, scene.test)])
    g.save(folder / "scene.ply")
    save_cameras(folder, shot)
    return shot


def test_what_the_photos_show_otherwise_is_not_trusted(tmp_path: Path) -> None:
    g = solid()
    wrong = g.means[:, 0] > g.means[:, 0].median()
    scene = as_run(tmp_path, g, wrong)
    known = load_cameras(tmp_path)
    trust = learn_trust(g, known)
    seen = trust.photos >= 2
    assert float(trust.errors[wrong & seen].median()) > 5 * float(trust.errors[~wrong & seen].median())
    assert int(trust.photos.max()) <= len(scene.train)
    for view in scene.test:
        error = 255 * (g.render(view.camera).clamp(0, 1) - torch.from_numpy(view.image) / 255).abs().mean(-1)
        bound = torch.from_numpy(trust.bound(view.camera))
        doubtful = error > 10
        assert 0.05 < float(doubtful.float().mean()) < 0.95
        assert float(bound[doubtful].mean()) > 2 * float(bound[error < 2].mean())
    measured = measure_trust(trust, known)
    assert measured is not None
    assert measured.ause < 0.5 * measured.by_photos
    assert measured.right > 0.95
    assert 0.2 < measured.good < 0.8
    assert "AUSE" in str(measured)
    none = replace(known, views=[view for view in known.views if not view.held_out])
    assert measure_trust(trust, none) is None


def test_each_gaussian_gets_its_weights_in_the_pixels() -> None:
    """Against the render of one colour at a time: what a Gaussian adds to a pixel is its weight."""
    g = random_gaussians(12, 0)
    g.means[:] = 0.3 * g.means + torch.tensor([0.0, 0.0, 3.0])
    camera = Camera(20, 14, np.array([[20.0, 0, 10], [0, 20, 7], [0, 0, 1]]), np.eye(4))
    weights = g.rasterize(camera, torch.eye(12))[0][0]
    pixels = torch.rand(14, 20, 1, generator=torch.Generator().manual_seed(0))
    wanted = torch.einsum("hwn,hwd->nd", weights, pixels)
    torch.testing.assert_close(_back(g, camera, torch.zeros(12, 1), pixels), wanted, rtol=1e-4, atol=1e-5)
    values = torch.rand(12, 1, generator=torch.Generator().manual_seed(1))
    ratio = (pixels + FLOOR) / (weights @ values + FLOOR)
    wanted = torch.einsum("hwn,hwd->nd", weights, ratio)
    torch.testing.assert_close(_back(g, camera, values, pixels, ratio=True), wanted, rtol=1e-4, atol=1e-5)


def test_what_is_empty_has_the_error_of_nothing_known(tmp_path: Path) -> None:
    g = solid()
    as_run(tmp_path, g, torch.zeros(len(g), dtype=torch.bool))
    trust = learn_trust(g, load_cameras(tmp_path))
    away = Camera(8, 6, np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), np.diag([-1.0, 1, -1, 1]))
    alpha = g.rasterize(away, torch.zeros(len(g), 1))[1]
    assert not alpha.any()
    np.testing.assert_allclose(trust.bound(away), 255 * EMPTY, rtol=1e-5)
    assert trust.bound(away).min() > GOOD


def test_threads_change_no_bit(tmp_path: Path) -> None:
    g = solid()
    as_run(tmp_path, g, g.means[:, 1] > 0)
    before, known = hqgs.get_num_threads(), load_cameras(tmp_path)
    try:
        found = []
        for threads in (1, 3):
            hqgs.set_num_threads(threads)
            found.append(learn_trust(g, known).errors)
    finally:
        hqgs.set_num_threads(before)
    assert torch.equal(*found)


def test_sparsification_by_hand() -> None:
    error = np.array([4.0, 1.0, 3.0, 2.0] * 50, np.float32)
    assert _ause(error, error) == 0
    shares = np.linspace(0, 200, 51)[1:].astype(int)
    worst, best = np.sort(error)[::-1], np.sort(error)
    wanted = np.mean([worst[:n].mean() - best[:n].mean() for n in shares]) / error.mean()
    assert _ause(-error, error) == pytest.approx(wanted)
    assert 0 < _ause(np.ones(200, np.float32), error) < wanted


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    g = solid()
    as_run(tmp_path / "run", g, g.means[:, 0] > 0)
    call = ["render", str(tmp_path / "run"), "--show", "trust", "--out", str(tmp_path / "maps")]
    assert cli.main([*call, "--views", "test"]) == 0
    assert "trust: on the held-out photos " in capsys.readouterr().out
    assert len([*(tmp_path / "maps").glob("*.png")]) == len(tiny_scene().test)
    g.save(tmp_path / "alone.ply")
    call = ["render", str(tmp_path / "alone.ply"), "--show", "trust", "--out", str(tmp_path / "a.png")]
    assert cli.main(call) == 2
    assert "has no cameras.json and photos/" in capsys.readouterr().err
