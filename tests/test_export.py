"""`hqgs export`: what is left out changes no pixel by more than it says, and the command line."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures_scenes import make_truth, photographed, write_colmap
from reference import sh_basis
from test_ply import random_gaussians
from tiny_scene import tiny_scene

from hqgs.cli import main as cli
from hqgs.evaluation import held_out
from hqgs.evaluation.held_out import held_out_psnr, held_out_renders
from hqgs.model.formats.spz import encode_spz
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene import source as scene_source
from hqgs.scene.camera_files import load_cameras, save_cameras
from hqgs.scene.scene import Camera
from hqgs.show.export import along_a_curve, export, file_degree, measure, needed_degrees, reduce_gaussians
from hqgs.show.export_options import ExportOptions

CAMERA = Camera(48, 32, np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), np.eye(4))


def some_gaussians(n: int = 300, sh_degree: int = 3) -> Gaussians:
    """In view of CAMERA, with harmonics of very different strength."""
    g = random_gaussians(n, sh_degree)
    g.means[:] = g.means * torch.tensor([0.6, 0.4, 0.3]) + torch.tensor([0.0, 0.0, 3.0])
    g.scales[:] = 0.3 * g.scales - 2
    g.shN[:] *= 0.3 * 10.0 ** -torch.linspace(0, 4, n)[:, None, None]
    return g


def rows(g: Gaussians) -> set[tuple[float, ...]]:
    return {tuple(row) for row in torch.cat([t.flatten(1) for t in as_columns(g)], dim=1).tolist()}


def as_columns(g: Gaussians) -> list[torch.Tensor]:
    return [t[:, None] if t.ndim == 1 else t for t in g.named().values()]


def picture(g: Gaussians) -> torch.Tensor:
    with torch.no_grad():
        return render_view(g, CAMERA, g.sh_degree, (0.2, 0.5, 0.8))[0]


@pytest.mark.parametrize("tolerance", [0.0, 0.004, 0.05])
def test_the_bands_above_the_needed_degree_stay_below_the_tolerance(tolerance: float) -> None:
    g = some_gaussians()
    g.shN[5, 8:] = 0  # nothing of degree 3
    degrees = needed_degrees(g, tolerance)
    dirs = torch.nn.functional.normalize(
        torch.randn(4000, 3, generator=torch.Generator().manual_seed(1)).double()
    )
    basis = sh_basis(dirs)  # [4000, 16]
    change = torch.zeros(len(g), 4)  # by the degree that stays
    opacities = g.activated_opacities().double()
    for kept in range(4):
        first = (kept + 1) ** 2
        above = torch.einsum("dk,nkc->ndc", basis[:, first:], g.shN.double()[:, first - 1 :])
        change[:, kept] = opacities * above.abs().amax(dim=(1, 2)) if kept < 3 else 0
    assert (change[torch.arange(len(g)), degrees] <= tolerance + 1e-12).all()
    assert degrees[5] == (2 if tolerance == 0 else degrees[5])
    if tolerance:
        assert {0, 1, 2, 3} == set(degrees.tolist())
        lower = degrees > 0
        below = change[lower, degrees[lower] - 1]
        assert (below > 0.25 * tolerance).all()  # the bound is no more than a few times what there is
        ones = g.shN.abs()[:, 3:].amax(dim=(1, 2)) == 0
        assert not ones.any()


def test_the_bound_is_reached_by_a_band_of_degree_1() -> None:
    g = random_gaussians(1, 1)
    g.opacities[:] = 30.0
    g.shN[:] = 0
    g.shN[0, :, 1] = torch.tensor([0.1, -0.2, 0.2])  # norm 0.3
    reach = 0.3 * math.sqrt(3 / (4 * math.pi))
    assert needed_degrees(g, reach * 0.999).tolist() == [1]
    assert needed_degrees(g, reach * 1.001).tolist() == [0]


def test_a_layer_changes_a_pixel_by_no_more_than_the_tolerance() -> None:
    g = some_gaussians()
    for i in range(0, 300, 30):
        one = Gaussians(**{name: t[i : i + 1] for name, t in g.named().items()})
        reduced, _ = reduce_gaussians(one, ExportOptions("spz", band_tolerance=0.01))
        assert (picture(reduced) - picture(one)).abs().max() <= 0.01 + 1e-6


def test_what_no_pixel_shows_is_left_out_without_a_change_of_a_bit() -> None:
    g = some_gaussians()
    g.opacities[3] = math.log(1 / 254) - 1e-3  # just below 1/255
    g.opacities[7] = math.log(1 / 254) + 1e-3
    g.quats[11] = 0
    g.means[20, 2] = torch.nan
    reduced, left_out = reduce_gaussians(g, ExportOptions("ply", band_tolerance=0.0))
    assert [(item.what, item.why) for item in left_out] == [
        ("1 Gaussians", "their values are NaN or Inf"),
        ("2 Gaussians", "invisible (opacity below 1/255, or no rotation)"),
    ]
    kept = torch.tensor([i for i in range(300) if i not in (3, 11, 20)])
    assert torch.equal(reduced.means, g.means[kept])
    assert torch.equal(picture(reduced), picture(g))


def test_a_band_that_next_to_none_needs_is_left_out_for_all() -> None:
    degrees = torch.zeros(2000, dtype=torch.int64)
    degrees[:2] = 3
    degrees[2:5] = 2
    assert file_degree(degrees, 3) == 2  # two of 2,000 are 1 in 1,000, five are not
    degrees[:5] = 3
    assert file_degree(degrees, 3) == 3
    assert file_degree(degrees, 1) == 1
    assert file_degree(degrees[5:], 3) == 0
    assert file_degree(degrees[:0], 3) == 0


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_ply_holds_the_bands_that_are_asked_for_exactly(tmp_path: Path, sh_degree: int) -> None:
    g = some_gaussians()
    written = export(g, tmp_path / "a.ply", ExportOptions("ply", sh_degree, band_tolerance=0.0))
    back = Gaussians.load(tmp_path / "a.ply")
    assert (back.sh_degree, written.sh_degree, written.gaussians) == (sh_degree, sh_degree, 300)
    assert torch.equal(back.shN, g.shN[:, : (sh_degree + 1) ** 2 - 1])
    assert torch.equal(back.means, g.means)
    assert g.sh_degree == 3  # what was given stays as it is


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_spz_zeroes_the_bands_of_each_gaussian(tmp_path: Path, sh_degree: int) -> None:
    g = some_gaussians()
    g.opacities[:4] = -9.0
    options = ExportOptions("spz", sh_degree, sh_bits=(8, 8))
    written = export(g, tmp_path / "a.spz", options)
    back = Gaussians.load(tmp_path / "a.spz")
    assert (len(back), back.sh_degree) == (296, sh_degree)
    assert written.left_out[0].what == "4 Gaussians"
    assert len(written.left_out) == (3 if 0 < sh_degree < 3 else 2)
    assert written.bytes < len(encode_spz(along_a_curve(g).arrays(), (8, 8)).data)
    degrees = needed_degrees(along_a_curve(steps_last(g, ExportOptions("ply", band_tolerance=0.0))), 0.004)
    above = torch.arange(back.shN.shape[1]) >= ((degrees + 1).square() - 1)[:, None]
    assert (back.shN[above] == 0).all()
    if sh_degree:
        assert above.any()
        assert (back.shN[~above] != 0).any()


def steps_last(g: Gaussians, options: ExportOptions) -> Gaussians:
    return reduce_gaussians(g, options)[0]


def test_the_curve_only_changes_the_order() -> None:
    g = some_gaussians()
    g.means[0] = 1e6
    ordered = along_a_curve(g)
    assert rows(ordered) == rows(g)
    steps = (ordered.means[1:] - ordered.means[:-1]).norm(dim=1).median()
    assert steps < 0.6 * (g.means[1:] - g.means[:-1]).norm(dim=1).median()
    same = replace(g, means=torch.ones(300, 3))
    assert torch.equal(along_a_curve(same).sh0, same.sh0)


@pytest.mark.parametrize("name", ["a.ply", "a.spz"])
def test_no_gaussian_at_all(tmp_path: Path, name: str) -> None:
    written = export(random_gaussians(0), tmp_path / name, ExportOptions(name[2:]))
    assert (written.gaussians, written.left_out[0].what) == (0, "harmonics of degrees 1 to 3")
    assert len(Gaussians.load(tmp_path / name)) == 0


def test_options_are_checked() -> None:
    for wrong, message in (
        ({"format": "obj"}, "format is 'obj', wanted one of: ply, full.ply, compressed.ply, spz, splat, glb"),
        ({"sh_degree": 4}, "sh_degree is 4"),
        ({"band_tolerance": -0.1}, "band_tolerance is -0.1"),
        ({"band_tolerance": math.nan}, "band_tolerance is nan"),
        ({"sh_bits": (9, 4)}, "sh_bits is"),
    ):
        with pytest.raises(ValueError, match=message):
            ExportOptions(**({"format": "ply"} | wrong))  # type: ignore[arg-type]


def call(*arguments: str | Path) -> int:
    return cli.main(["export", *map(str, arguments)])


def test_the_command_on_a_run_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tiny_scene()
    g = Gaussians.from_points(scene.points, scene.point_colors)
    g.means[:, 2] += torch.linspace(0, 0.1, len(g))  # at one depth the order in the file would decide
    g.opacities[:] = 2.0
    g.opacities[0] = -8.0
    run = tmp_path / "run"
    g.save(run / "scene.ply")
    monkeypatch.setattr(scene_source, "embedded_scene", lambda *_: scene)
    out = tmp_path / "new" / "a.spz"
    assert call(run, "--out", out, "--scene", "embedded", "--downscale", "2") == 0
    text = capsys.readouterr().out
    before = held_out_psnr(scene, held_out_renders(scene, g))
    after = held_out_psnr(scene, held_out_renders(scene, Gaussians.load(out)))
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "|" in line]
    size = (run / "scene.ply").stat().st_size
    share = f"{100 * out.stat().st_size / size:.1f} %"
    assert table[2] == [str(run / "scene.ply"), "40", "3", f"{size:,}", "", f"{before:.3f}", ""]
    assert table[3][:5] == [str(out), "39", "0", f"{out.stat().st_size:,}", share]
    assert table[3][5:] == [f"{after:.3f}", f"{after - before:+.3f}"]
    assert abs(after - before) < 0.1
    assert "left out: 1 Gaussians: invisible" in text
    assert "left out: harmonics of degrees 1 to 3: at most 1 in 1,000 Gaussians needs them (0 of 39" in text
    assert "measured: renders of 4 cameras around the scene change by 0." in text


def test_photos_are_held_out_as_the_run_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, model = photographed(make_truth(9))
    photos, run = write_colmap(truth, tmp_path / "photos", binary=False), tmp_path / "run"
    model.save(run / "scene.ply")
    (run / "config.json").write_text('{"scene": {"test_every": 3}}')
    measured = []
    monkeypatch.setattr(held_out, "held_out_psnr", lambda scene, _: measured.append(scene.test) or 1.0)
    assert call(run, "--out", tmp_path / "a.ply", "--scene", photos) == 0
    assert [len(test) for test in measured] == [3, 3]


def test_what_a_file_changes_is_measured_in_the_cameras_of_its_run(tmp_path: Path) -> None:
    scene, g = tiny_scene(), some_gaussians(40, 0)
    other = g.like(g.named() | {"sh0": g.sh0 + torch.tensor([0.3, 0.0, 0.0])})
    save_cameras(tmp_path, scene)
    change = measure(g, other, load_cameras(tmp_path))
    pairs = [[255 * x.render(view.camera).clamp(0, 1).double() for x in (g, other)] for view in scene.test]
    away = [(a - b).abs() for a, b in pairs]
    flat = torch.cat([x.flatten() for x in away])
    assert change.mean == pytest.approx(float(flat.mean()))
    assert change.psnr == pytest.approx(10 * math.log10(255**2 / float(flat.square().mean())))
    assert change.worst == float(flat.max()) > 5
    name, row, column = change.where
    names = [view.name for view in scene.test]
    assert float(away[names.index(name)][row, column].max()) == change.worst
    assert str(change).startswith(
        f"renders of {len(names)} held-out views change by {change.mean:.2f} levels"
    )
    assert str(measure(g, g, None)) == "no pixel of renders of 4 cameras around the scene changes"


def test_the_format_can_be_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some_gaussians().save(tmp_path / "a.ply")
    assert call(tmp_path / "a.ply", "--out", tmp_path / "b", "--format", "spz", "--sh-bits", "6", "3") == 0
    assert "PSNR" not in capsys.readouterr().out
    assert len(Gaussians.load(tmp_path / "b", "spz")) == 300


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("a.glb", True),
        ("a.splat", True),
        ("a.compressed.ply", False),
        ("a.spz", False),
        ("a.sog", False),
        ("a.full.ply", False),
    ],
)
def test_a_lost_antialias_flag_is_told(
    tmp_path: Path, name: str, told: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    g = some_gaussians()
    g.antialiased = True
    g.save(tmp_path / "source.ply")
    assert call(tmp_path / "source.ply", "--out", tmp_path / name) == 0
    assert ("left out: the antialias flag: a ." in capsys.readouterr().out) == told
    assert Gaussians.load(tmp_path / name).antialiased != told


def test_what_the_reading_left_out_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.PLY"
    some_gaussians().save(path)
    path.write_bytes(path.read_bytes() + b"end")
    for arguments in (
        ["info", path],
        ["render", path, "--out", tmp_path / "a.png", "--size", "16", "16"],
        ["export", path, "--out", tmp_path / "a.spz"],
    ):
        assert cli.main([*map(str, arguments)]) == 0
        assert "read: 3 bytes after its last row were ignored" in capsys.readouterr().out


def test_bad_input_is_one_line_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some_gaussians().save(tmp_path / "a.ply")
    far = some_gaussians()
    far.means[:] += 1e6
    far.save(tmp_path / "far.ply")
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.iterdir())
    for source, out, message, *more in (
        ("a.ply", "b.ksplat", "unknown suffix"),
        ("none.ply", "b.ply", "there is no"),
        ("empty", "b.ply", "scene.ply"),
        ("far.ply", "b.spz", "means: SPZ has 24 bits"),
        ("a.ply", "b.spz", "sh_degree is 5", "--sh-degree", "5"),
        ("a.ply", "b.spz", "no-such-scene", "--scene", str(tmp_path / "no-such-scene")),
        ("a.ply", "a.ply/b.spz", "a.ply"),
    ):
        assert call(tmp_path / source, "--out", tmp_path / out, *more) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert message in lines[0]
    assert sorted(tmp_path.iterdir()) == before
