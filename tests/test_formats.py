"""Scene files of other programs: what comes back, what an independent reader sees, and files that lie.

The readers here are written from the formats' descriptions, or another project's: none is hqgs's own.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
import torch
from test_ply import random_gaussians
from test_spz import angles

from hqgs.cli import main as cli
from hqgs.model.constants import SH_C0
from hqgs.model.formats.files import FORMATS as FORMATS_OF_FILES
from hqgs.model.formats.sog import codebook, palette
from hqgs.model.gaussians import Gaussians
from hqgs.scene.names import SCENE_SUFFIXES
from hqgs.scene.paths import look_at

FORMATS = ("splat", "compressed.ply", "glb")


def nearest(found: np.ndarray, g: Gaussians) -> torch.Tensor:
    """For each row of a file in another order, the Gaussian that it is."""
    order = ((found[:, None].astype(np.float64) - g.means.numpy()[None]) ** 2).sum(2).argmin(1)
    assert len(set(order)) == len(g)
    return torch.from_numpy(order)


def of(g: Gaussians, rows: torch.Tensor) -> Gaussians:
    return Gaussians(**{name: tensor[rows] for name, tensor in g.named().items()})


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_gltf_comes_back_but_for_rounding(tmp_path: Path, sh_degree: int) -> None:
    g = random_gaussians(300, sh_degree)
    g.opacities[:2], g.scales[0] = torch.tensor([40.0, -40.0]), torch.tensor([-60.0, 30.0, 0.0])
    assert g.save(tmp_path / "a.glb") == 0
    back = Gaussians.load(tmp_path / "a.glb")
    assert torch.equal(back.means, g.means)
    assert torch.equal(back.sh0, g.sh0)
    assert torch.equal(back.shN, g.shN)
    assert (back.scales - g.scales).abs().max() < 1e-5
    assert angles(back.quats, g.quats).max() < 1e-6
    assert (back.activated_opacities() - g.activated_opacities()).abs().max() < 1e-6


def test_another_reader_finds_the_gltf_scene_turned_upright(tmp_path: Path) -> None:
    """Chunks, accessors and attributes read by hand; y is up there: a turned camera sees the same."""
    g = random_gaussians(40, 2)
    g.means[:] = 0.3 * g.means + torch.tensor([0.0, 0.0, 4.0])
    g.scales[:] = 0.3 * g.scales - 2.0
    g.save(tmp_path / "a.glb")
    file = (tmp_path / "a.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", file)
    assert (magic, version, length, kind, size % 4) == (b"glTF", 2, len(file), b"JSON", 0)
    content, data = json.loads(file[20 : 20 + size]), file[28 + size :]
    assert file[24 + size : 28 + size] == b"BIN\0"
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    (primitive,) = content["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    found: dict[str, torch.Tensor] = {}
    for name, number in primitive["attributes"].items():
        accessor = content["accessors"][number]
        view = content["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126
        values = np.frombuffer(data, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        found[name.split(":")[-1]] = torch.from_numpy(values.copy())
        if name == "POSITION":
            np.testing.assert_array_equal(accessor["max"], values.max(0))
            np.testing.assert_array_equal(accessor["min"], values.min(0))
    higher = [found[f"SH_DEGREE_{d}_COEF_{n}"] for d in (1, 2) for n in range(2 * d + 1)]
    theirs = Gaussians(
        means=found["POSITION"],
        scales=found["SCALE"].log(),
        quats=found["ROTATION"].roll(1, dims=1),
        opacities=torch.logit(found["OPACITY"][:, 0]),
        sh0=found["SH_DEGREE_0_COEF_0"][:, None],
        shN=torch.stack(higher, 1),
    )
    ours = g.render(look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0), width=60, height=50))
    upright = theirs.render(look_at((0, 0, 0), (0, 0, -1), up=(0, 1, 0), width=60, height=50))
    assert ours.std() > 0.05
    assert (ours - upright).abs().max() < 1e-4


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_another_reader_finds_the_compressed_scene(tmp_path: Path, sh_degree: int) -> None:
    """gsply, which is written after PlayCanvas' own reader."""
    gsply = pytest.importorskip("gsply")
    g = random_gaussians(600, sh_degree)
    g.opacities.clamp_(-5, 5)
    assert g.save(tmp_path / "a.compressed.ply") == 0
    theirs = gsply.plyread(str(tmp_path / "a.compressed.ply"))
    same = of(g, nearest(theirs.means, g))
    span = 8.0  # of 600 normal numbers
    assert np.abs(theirs.means - same.means.numpy()).max() < span / 1023
    assert np.abs(theirs.scales - same.scales.numpy()).max() < span / 1023
    assert angles(torch.from_numpy(theirs.quats), same.quats).max() < 0.004
    opacities = torch.sigmoid(torch.from_numpy(np.ravel(theirs.opacities)))
    assert (opacities - same.activated_opacities()).abs().max() < 0.6 / 255
    assert np.abs(theirs.sh0.reshape(-1, 3) - same.sh0[:, 0].numpy()).max() < span / 255
    if sh_degree:
        rest = np.asarray(theirs.shN).reshape(600, -1, 3)
        inside = same.shN.numpy().clip(-4, 4 - 1 / 32)
        assert np.abs(rest - inside).max() < 1 / 64 + 1e-6
    ours = Gaussians.load(tmp_path / "a.compressed.ply")
    assert np.abs(ours.means.numpy() - theirs.means).max() < 1e-5
    assert angles(ours.quats, torch.from_numpy(theirs.quats)).max() < 1e-5
    assert ours.sh_degree == sh_degree


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_compressed_files_come_back_within_the_stated_errors(tmp_path: Path, sh_degree: int) -> None:
    g = random_gaussians(700, sh_degree)
    g.scales[0] = 30.0  # beyond the limit
    g.save(tmp_path / "a.compressed.ply")
    file = plyfile.PlyData.read(str(tmp_path / "a.compressed.ply"))
    chunks = file["chunk"].data
    assert len(chunks) == 3
    back = Gaussians.load(tmp_path / "a.compressed.ply")
    order = nearest(back.means.numpy(), g)
    same, chunk = of(g, order), np.arange(700) // 256
    for axis, levels in zip("xyz", (2047, 1023, 2047), strict=True):
        k = "xyz".index(axis)
        box = (chunks[f"max_{axis}"] - chunks[f"min_{axis}"])[chunk]
        away = np.abs(back.means[:, k].numpy() - same.means[:, k].numpy()) / box
        assert 0.2 / levels < away.max() <= 0.501 / levels
        logs = (chunks[f"max_scale_{axis}"] - chunks[f"min_scale_{axis}"])[chunk]
        away = np.abs(back.scales[:, k].numpy() - same.scales[:, k].clamp(-20, 20).numpy()) / logs
        assert away.max() <= 0.502 / levels
    assert angles(back.quats, same.quats).max() <= 0.004
    assert (back.activated_opacities() - same.activated_opacities()).abs().max() <= 0.501 / 255
    inside = same.shN.clamp(-4, 4 - 1 / 32)
    assert (back.shN - inside).abs().max() <= 1 / 64 + 1e-6 if sh_degree else True


def test_a_compressed_file_without_colours_of_chunks_is_read(tmp_path: Path) -> None:
    """As the first version of the format was: colours from 0 to 1."""
    g = random_gaussians(5, 0)
    g.sh0[:] = g.sh0.clamp(-1.5, 1.5)
    g.save(tmp_path / "a.compressed.ply")
    file = plyfile.PlyData.read(str(tmp_path / "a.compressed.ply"))
    old = file["chunk"].data[[n for n in file["chunk"].data.dtype.names if n[-1] not in "rgb"]]
    old = np.array(old.tolist(), [(name, "<f4") for name in old.dtype.names])
    words = file["vertex"].data.copy()
    words["packed_color"] = 0xFF800040
    plyfile.PlyData(
        [plyfile.PlyElement.describe(old, "chunk"), plyfile.PlyElement.describe(words, "vertex")],
        byte_order="<",
    ).write(str(tmp_path / "old.ply"))
    back = Gaussians.load(tmp_path / "old.ply")  # known by its content
    colors = 0.5 + SH_C0 * back.sh0[:, 0]
    assert torch.allclose(colors, torch.tensor([1.0, 128 / 255, 0.0]).expand(5, 3), atol=1e-6)
    assert torch.allclose(back.activated_opacities(), torch.full((5,), 64 / 255))


def test_another_reader_finds_the_splat_scene(tmp_path: Path) -> None:
    """Thirty-two bytes a Gaussian, taken apart one by one."""
    g = random_gaussians(50, 2)
    assert g.save(tmp_path / "a.splat") == 0
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 50 * 32
    rows = [struct.unpack_from("<6f8B", data, 32 * k) for k in range(50)]
    same = of(g, nearest(np.array([row[:3] for row in rows]), g))
    shown = [same.scales[k].sum() + math.log(same.activated_opacities()[k]) for k in range(50)]
    assert shown == sorted(shown, reverse=True)
    for k, (x, y, z, sx, sy, sz, r, gr, b, a, *turn) in enumerate(rows):
        assert (x, y, z) == tuple(same.means[k].tolist())
        assert torch.allclose(torch.tensor([sx, sy, sz]), same.scales[k].exp(), rtol=1e-6)
        color = (0.5 + SH_C0 * same.sh0[k, 0]).clamp(0, 1) * 255
        assert (torch.tensor([r, gr, b]) - color).abs().max() <= 0.5 + 1e-4
        assert abs(a - 255 * float(same.activated_opacities()[k])) <= 0.5 + 1e-4
        quat = (torch.tensor(turn, dtype=torch.float32) - 128) / 128
        assert angles(quat[None], same.quats[k : k + 1]) < 0.02
    back = Gaussians.load(tmp_path / "a.splat")
    assert torch.equal(back.means, same.means)
    assert (back.scales - same.scales).abs().max() < 1e-5
    assert angles(back.quats, same.quats).max() < 0.02
    assert back.sh_degree == 0


@pytest.mark.parametrize("name", [*FORMATS, "spz", "sog"])
def test_broken_rows_stay_out_and_an_empty_scene_is_none(tmp_path: Path, name: str) -> None:
    g = random_gaussians(9, 1)
    g.means[1, 1], g.opacities[2], g.shN[3, 0, 0] = torch.nan, torch.inf, -torch.inf
    g.quats[4] = 0
    assert g.save(tmp_path / f"a.{name}") == 4
    back = Gaussians.load(tmp_path / f"a.{name}").means
    assert (torch.cdist(back, g.means[[0, 5, 6, 7, 8]]).min(0).values < 0.03).all()
    assert len(back) == 5
    (tmp_path / "none").write_bytes(b"")
    with pytest.raises(ValueError, match="none"):
        Gaussians.load(tmp_path / "none", name)


@pytest.mark.parametrize("name", FORMATS)
def test_export_writes_it_and_says_what_is_left_out(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    g = random_gaussians(300, 3)
    g.save(tmp_path / "scene.ply")
    assert cli.main(["export", str(tmp_path / "scene.ply"), "--out", str(tmp_path / f"a.{name}")]) == 0
    told = capsys.readouterr().out
    back = Gaussians.load(tmp_path / f"a.{name}")
    assert (len(back), back.sh_degree) == (300, 0 if name == "splat" else 3)
    assert ("a .splat file cannot store them" in told) == (name == "splat")
    assert f"{(tmp_path / f'a.{name}').stat().st_size:,}" in told


def attributes(content: Any) -> Any:
    return content["meshes"][0]["primitives"][0]["attributes"]


def change_gltf(path: Path, change: Any) -> None:
    file = path.read_bytes()
    (size,) = struct.unpack_from("<I", file, 12)
    content = json.loads(file[20 : 20 + size])
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, len(file) - size + len(text))
    path.write_bytes(head + struct.pack("<I", len(text)) + b"JSON" + text + file[20 + size :])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["nodes"][0].update(scale=[1, 0, 1]), "the transform is singular"),
        (lambda c: c["nodes"][0].update(rotation=[0, 0, 0, "x"]), "a node has no valid transform"),
        (lambda c: c["nodes"][0].update(children=[0]), "do not form a tree"),
        (lambda c: c["meshes"][0]["primitives"][0].pop("extensions"), "no primitive with KHR_gaussian"),
        (lambda c: c["accessors"][1].update(componentType=5122), "accessor 1 is not VEC4 of float32"),
        (lambda c: c["accessors"][0].update(count=10**12), "accessor 0 reaches beyond the data"),
        (lambda c: c["bufferViews"][0].update(byteOffset=-4), "accessor 0 reaches beyond the data"),
        (lambda c: c["bufferViews"][0].update(byteLength=10**12), "accessor 0 reaches beyond the data"),
        (lambda c: attributes(c).pop("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"), "3 coef"),
    ],
)  # fmt: skip
def test_gltf_that_is_not_read_is_named(tmp_path: Path, change: Any, message: str) -> None:
    random_gaussians(4, 1).save(tmp_path / "a.glb")
    change_gltf(tmp_path / "a.glb", change)
    with pytest.raises(ValueError, match=rf"a\.glb.*{message}"):
        Gaussians.load(tmp_path / "a.glb")


def test_names_that_are_told_from_photos_are_those_of_the_table() -> None:
    ends = {f".{name.rpartition('.')[2]}" for name in FORMATS_OF_FILES} - {".json"}
    assert set(SCENE_SUFFIXES) == ends


# --- SOG as it is written, read by our reader and by another one


def matched(read: Gaussians, g: Gaussians) -> Gaussians:
    """The Gaussians of the file in the order of those that were written."""
    order = torch.cdist(g.means.double(), read.means.double()).argmin(1)
    assert len(set(order.tolist())) == len(g)
    return read.rows(order)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_within_the_bounds(tmp_path: Path, degree: int) -> None:
    g = random_gaussians(1200, degree)
    g.antialiased = degree == 2
    assert g.save(tmp_path / "a.sog") == 0
    read = Gaussians.load(tmp_path / "a.sog")
    assert (len(read), read.sh_degree, read.antialiased) == (1200, degree, degree == 2)
    read = matched(read, g)
    logs = [torch.sign(x.means) * torch.log1p(x.means.abs()) for x in (g, read)]
    step = (logs[0].amax(0) - logs[0].amin(0)) / 65535
    assert ((logs[0] - logs[1]).abs() <= 0.5 * step + 1e-6).all()
    assert (g.activated_opacities() - read.activated_opacities()).abs().max() <= 0.5 / 255 + 1e-3
    unit = torch.nn.functional.normalize(g.quats, dim=1), torch.nn.functional.normalize(read.quats, dim=1)
    angles = 2 * torch.arccos((unit[0] * unit[1]).sum(1).abs().clamp(max=1))
    assert 0 < angles.max() <= 0.02
    for before, after in ((g.scales, read.scales), (g.sh0, read.sh0)):
        assert (before - after).square().mean() < 2e-4 * before.var()
    assert (tmp_path / "a.sog").stat().st_size < 45 * 1200


def test_another_reader_finds_the_same(tmp_path: Path) -> None:
    pytest.importorskip("imagecodecs")
    gsply = pytest.importorskip("gsply")
    g = random_gaussians(500, 3)
    g.save(tmp_path / "a.sog")
    ours, theirs = Gaussians.load(tmp_path / "a.sog"), gsply.sogread(str(tmp_path / "a.sog"))
    np.testing.assert_allclose(theirs.means, ours.means, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(theirs.scales, ours.scales, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.abs((theirs.quats * ours.quats.numpy()).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(theirs.sh0, ours.sh0[:, 0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(theirs.shN, ours.shN, rtol=1e-5, atol=1e-5)


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    g = random_gaussians(300, 3)
    for name in ("a.sog", "b.sog"):
        g.save(tmp_path / name)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_a_codebook_holds_what_there_is() -> None:
    values = np.array([[-3.0, 0.5, 0.5], [7.0, -3.0, 1e-3]])
    book, codes = codebook(values)
    assert len(book) == 256
    np.testing.assert_allclose(book[codes], values, rtol=1e-6)
    rng = np.random.default_rng(0)
    many = rng.normal(size=20_000) ** 3  # most near 0, some far off
    book, codes = codebook(many)
    assert (np.abs(many[:, None] - book).argmin(1) == codes).mean() > 0.999
    even = np.linspace(many.min(), many.max(), 256)
    nearest = np.abs(many[:, None] - even).min(1)
    assert np.square(book[codes] - many).mean() < 0.3 * np.square(nearest).mean()


def test_a_palette_finds_the_kinds_that_there_are() -> None:
    rng = np.random.default_rng(0)
    kinds = rng.normal(size=(30, 45))
    rows = kinds[rng.integers(30, size=3000)] + 0.01 * rng.normal(size=(3000, 45))
    sets, labels = palette(rows, np.ones(3000), 200)
    assert len(sets) <= 200
    assert labels.max() < len(sets)
    assert np.square(sets[labels] - rows).mean() < 1e-3 * rows.var()
    (one,), labels = palette(rows[:1], np.ones(1), 1)
    np.testing.assert_allclose(one, rows[0])
    assert labels.tolist() == [0]
