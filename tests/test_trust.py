"""Maps of trust: what photos say of the Gaussians, and what that says of a pixel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from test_ply import random_gaussians
from tiny_scene import tiny_scene

import hqgs
from hqgs.cli import main as cli
from hqgs.model.gaussians import Gaussians
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.scene import Camera, Scene, View
from hqgs.show.trust import (
    EMPTY,
    FLOOR,
    SHARE,
    Held,
    _ause,
    _back,
    bound_of,
    calibrated,
    learn_trust,
    measure_trust,
)


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
    assert float(trust.errors[wrong].median()) > 5 * float(trust.errors[~wrong].median())
    for view in scene.test:
        error = 255 * (g.render(view.camera).clamp(0, 1) - torch.from_numpy(view.image) / 255).abs().mean(-1)
        bound = torch.from_numpy(trust.bound(view.camera))
        doubtful = error > 10
        assert 0.05 < float(doubtful.float().mean()) < 0.95
        assert float(bound[doubtful].mean()) > 2 * float(bound[error < 2].mean())
    measured = measure_trust(trust)
    assert measured is not None
    assert measured.ause < 0.2
    assert "AUSE" in str(measured)
    none = replace(known, views=[view for view in known.views if not view.held_out])
    alone = learn_trust(g, none)
    assert measure_trust(alone) is None
    assert alone.factor == 1
    assert torch.equal(alone.errors * trust.factor, trust.errors)


def test_what_a_mask_leaves_out_says_nothing_and_the_background_is_the_runs(tmp_path: Path) -> None:
    """The left half of all photos is masked, and white there; the others see Gaussians before red."""
    g, red, scene = solid(), (1.0, 0.0, 0.0), tiny_scene()
    g.opacities[:] = -1.0

    def photo(view: View) -> View:
        image = g.render(view.camera, background=red).clamp(0, 1).mul(255).round().byte().numpy()
        mask = np.ones((view.camera.height, view.camera.width), bool)
        mask[:, : mask.shape[1] // 2] = False
        return replace(view, image=np.where(mask[..., None], image, 255).astype(np.uint8), mask=mask)

    hidden = photo(scene.test[0])
    hidden = replace(hidden, name="hidden.png", mask=np.zeros_like(hidden.mask))
    shot = replace(scene, train=[*map(photo, scene.train)], test=[*map(photo, scene.test), hidden])
    save_cameras(tmp_path, shot, red)
    trust = learn_trust(g, load_cameras(tmp_path))
    assert [one.name for one in trust.held] == [view.name for view in scene.test]
    assert trust.held[0].flat(trust.held[0].error).mean() < 0.03  # of a JPEG
    measured = measure_trust(trust)
    assert measured is not None
    assert measured.covered >= SHARE - 0.01
    save_cameras(tmp_path, shot)
    black = learn_trust(g, load_cameras(tmp_path)).held[0]
    assert black.flat(black.error).mean() > 0.08


def held(error: np.ndarray, carried: np.ndarray) -> Held:
    one = np.ones_like(error)
    return Held("a", tiny_scene().test[0].camera, error, carried, one, one > 0)


def test_the_factor_keeps_nine_of_ten_pixels_below_their_bound() -> None:
    rng = np.random.default_rng(0)
    carried = rng.uniform(0.001, 0.05, (60, 50)).astype(np.float32)
    error = (carried * rng.exponential(3.0, carried.shape)).astype(np.float32).clip(0, 1)
    some = held(error, carried)
    factor = calibrated([some])
    below = lambda f: float((255 * error <= bound_of(np.float32(f) * carried, some.alpha)).mean())  # noqa: E731
    assert below(factor) == pytest.approx(SHARE, abs=0.001)
    assert calibrated([held(error, carried / 4)]) == pytest.approx(4 * factor, rel=1e-3)
    assert calibrated([]) == 1


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
    torch.testing.assert_close(
        _back(g, camera, values, pixels, torch.ones(pixels.shape[:2])), wanted, rtol=1e-4, atol=1e-5
    )


def test_what_is_empty_has_the_error_of_nothing_known(tmp_path: Path) -> None:
    g = solid()
    as_run(tmp_path, g, torch.zeros(len(g), dtype=torch.bool))
    trust = learn_trust(g, load_cameras(tmp_path))
    away = Camera(8, 6, np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), np.diag([-1.0, 1, -1, 1]))
    alpha = g.rasterize(away, torch.zeros(len(g), 1))[1]
    assert not alpha.any()
    np.testing.assert_allclose(trust.bound(away), 255 * EMPTY, rtol=1e-5)


def test_threads_change_no_bit(tmp_path: Path) -> None:
    g = solid()
    as_run(tmp_path, g, g.means[:, 1] > 0)
    known, found = load_cameras(tmp_path), []
    for threads in (1, 3):
        hqgs.set_num_threads(threads)
        found.append(learn_trust(g, known).errors)
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
    assert "trust: on 1 held-out photo " in capsys.readouterr().out
    assert len([*(tmp_path / "maps").glob("*.png")]) == len(tiny_scene().test)
    g.save(tmp_path / "alone.ply")
    call = ["render", str(tmp_path / "alone.ply"), "--show", "trust", "--out", str(tmp_path / "a.png")]
    assert cli.main(call) == 2
    assert "has neither cameras.json and photos/" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a.ply", "a.glb", "a.full.ply", "a.spz", "a.sog", "a.splat"])
def test_files_hold_it_or_say_that_they_do_not(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    g = solid()
    g.opacities[3] = -20.0  # left out
    as_run(tmp_path / "run", g, g.means[:, 0] > 0)
    errors = learn_trust(g, load_cameras(tmp_path / "run")).errors.clamp(max=1)
    call = ["export", str(tmp_path / "run"), "--trust", "--out"]
    holds = name in ("a.ply", "a.glb")
    assert cli.main([*call, str(tmp_path / name)]) == (0 if holds else 2)
    told = capsys.readouterr()
    if holds:
        back = Gaussians.load(tmp_path / name)
        assert back.errors is not None
        assert torch.equal(back.errors, torch.cat([errors[:3], errors[4:]]))
        assert cli.main(["info", str(tmp_path / name)]) == 0
        assert "it has an error for each Gaussian" in capsys.readouterr().out
        maps = ["render", str(tmp_path / name), "--show", "trust", "--out", str(tmp_path / "map.png")]
        assert cli.main([*maps, "--size", "40", "30"]) == 0
        back.save(tmp_path / "again.ply")
        assert torch.equal(Gaussians.load(tmp_path / "again.ply").errors, back.errors)  # type: ignore[arg-type]
    else:
        assert f"--trust: a .{name[2:]} file cannot store it; .ply and .glb files can" in told.err
        g.errors = errors
        g.save(tmp_path / "with.ply")
        assert cli.main(["export", str(tmp_path / "with.ply"), "--out", str(tmp_path / name)]) == 0
        assert f"left out: trust of the Gaussians: a .{name[2:]} file" in capsys.readouterr().out
        assert Gaussians.load(tmp_path / name).errors is None


def test_another_reader_finds_the_column(tmp_path: Path) -> None:
    g = solid()
    g.errors = torch.linspace(0, 1, len(g))
    g.save(tmp_path / "a.ply")
    rows = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"].data
    np.testing.assert_array_equal(rows["hqgs_error"], g.errors.numpy())
    rows = rows.copy()
    rows["hqgs_error"][:3] = np.nan, -1, 7
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(tmp_path / "b.ply")
    back = Gaussians.load(tmp_path / "b.ply")
    assert len(back) == len(g)
    assert back.errors is not None
    assert back.errors[:3].tolist() == [1, 1, 1]
