"""Scene files as people have them and at their edges: read by what they hold, or one sentence is said."""

from __future__ import annotations

import gzip
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

import hqgs
from hqgs.cli.main import main
from hqgs.model.constants import SH_C0
from hqgs.model.formats import gltf
from hqgs.model.formats.arrays import curve_order
from hqgs.model.gaussians import Gaussians


def some(n: int = 200, **changes: Any) -> hqgs.Gaussians:
    rng = torch.Generator().manual_seed(0)
    made = hqgs.Gaussians(
        torch.randn(n, 3, generator=rng),
        torch.rand(n, 3, generator=rng),
        torch.randn(n, 4, generator=rng),
        torch.linspace(0, 1, n),
        torch.randn(n, 1, 3, generator=rng),
        torch.zeros(n, 0, 3),
    )
    return replace(made, **changes)


@pytest.mark.parametrize("name", ["a.ply", "a.full.ply"])
def test_logits_that_look_like_shares_come_back(tmp_path: Path, name: str) -> None:
    scene = some()
    scene.save(tmp_path / name)
    back = hqgs.Gaussians.load(tmp_path / name)
    assert torch.equal(back.opacities, scene.opacities)
    assert torch.equal(back.scales, scene.scales)
    assert not back.notes


def test_the_frame_of_an_export_is_applied_once(tmp_path: Path) -> None:
    moved = {"transform": [[1, 0, 0, 3], [0, 0, 1, 0], [0, -1, 0, 0]], "scale": 0.5}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(moved))
    some().save(tmp_path / "other.ply")
    text = (tmp_path / "other.ply").read_bytes().replace(b"comment hqgs scene\n", b"")
    (tmp_path / "splat.ply").write_bytes(text)  # as nerfstudio writes it
    first = hqgs.Gaussians.load(tmp_path / "splat.ply")
    assert not torch.allclose(first.means, some().means, atol=0.1)
    first.save(tmp_path / "splat.ply")
    assert torch.equal(hqgs.Gaussians.load(tmp_path / "splat.ply").means, first.means)


def sog(path: Path, change: Any) -> Path:
    """A SOG file whose meta.json is changed."""
    some().save(path)
    with zipfile.ZipFile(path) as old:
        files = {name: old.read(name) for name in old.namelist()}
    meta = json.loads(files["meta.json"])
    change(meta)
    with zipfile.ZipFile(path, "w") as new:
        for name, content in (files | {"meta.json": json.dumps(meta).encode()}).items():
            new.writestr(name, content)
    return path


def test_a_codebook_without_its_first_entry(tmp_path: Path) -> None:
    def forget(meta: dict[str, Any]) -> None:
        book = meta["sh0"]["codebook"]
        book[0] = None

    assert hqgs.Gaussians.load(sog(tmp_path / "a.sog", forget)).finite().all()

    def damage(meta: dict[str, Any]) -> None:
        meta["sh0"]["codebook"] = 256 * [None]

    with pytest.raises(ValueError, match="not finite"):
        hqgs.Gaussians.load(sog(tmp_path / "b.sog", damage))


@pytest.mark.parametrize("suffix", ["sog", "splat"])
def test_a_scene_without_a_finite_gaussian(tmp_path: Path, suffix: str) -> None:
    for scene in (some(0), some(3, means=torch.full((3, 3), float("nan")))):
        with pytest.raises(ValueError, match=f"no Gaussian to write; a .{suffix} file needs at least one"):
            scene.save(tmp_path / f"a.{suffix}")
    assert not list(tmp_path.iterdir())


def test_a_plain_ply_called_compressed(tmp_path: Path) -> None:
    some().save(tmp_path / "a.ply")
    (tmp_path / "a.ply").rename(tmp_path / "a.compressed.ply")
    assert len(hqgs.Gaussians.load(tmp_path / "a.compressed.ply")) == 200


def test_gltf_of_interleaved_rows_and_of_normalized_integers() -> None:
    rows = np.arange(12, dtype="<f4").reshape(2, 6)
    content = {
        "accessors": [
            {"componentType": 5126, "type": "VEC3", "count": 2, "bufferView": 0},
            {"componentType": 5120, "type": "SCALAR", "count": 3, "bufferView": 1, "normalized": True},
            {"componentType": 5121, "type": "SCALAR", "count": 3, "bufferView": 1},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48, "byteStride": 24},
            {"buffer": 1, "byteLength": 12, "byteStride": 4},
        ],
    }
    small = np.zeros((3, 4), np.int8)
    small[:, 0] = [127, -128, 0]
    buffers = [rows.tobytes(), small.tobytes()]
    assert gltf._values(content, buffers, 0, "VEC3", 2).tolist() == [[0, 1, 2], [6, 7, 8]]
    assert gltf._values(content, buffers, 1, "SCALAR", 3)[:, 0].tolist() == [1, -1, 0]
    with pytest.raises(ValueError, match="accessor 2 is not SCALAR of float32 or normalized integers"):
        gltf._values(content, buffers, 2, "SCALAR", 3)
    content["bufferViews"][0]["byteLength"] = 35
    with pytest.raises(ValueError, match="accessor 0 reaches beyond the data"):
        gltf._values(content, buffers, 0, "VEC3", 2)


@pytest.mark.filterwarnings("error")
def test_points_of_a_plane_have_an_order() -> None:
    flat = np.random.default_rng(0).random((50, 3)) * [1, 1, 0]
    assert sorted(curve_order(flat)) == list(range(50))


# --- Scene files as people have them: read by what they hold, or one sentence says what they are


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3)).astype(np.float32)
    return Gaussians.from_points(points, rng.integers(0, 255, (40, 3)).astype(np.uint8), 1)


@pytest.mark.parametrize("held", ["ply", "compressed.ply", "spz", "glb", "sog"])
@pytest.mark.parametrize(
    "called", ["scene.ply", "scene.spz", "scene.splat", "scene.glb", "scene.zip", "scene"]
)
def test_a_file_is_read_by_what_it_holds(
    held: str, called: str, gaussians: Gaussians, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / f"own.{held}"
    gaussians.save(own)
    wanted = Gaussians.load(own)
    path = tmp_path / called
    own.rename(path)
    for name, tensor in wanted.named().items():
        assert torch.equal(Gaussians.load(path).named()[name], tensor), name
    assert main(["info", str(path)]) == 0
    assert "40 Gaussians" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "empty: the download failed"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 5\n", "a pointer of Git LFS"),
        (b"\n<!DOCTYPE html><html><body>404</body></html>", "a web page: download the file itself"),
        (gzip.compress(b"ply\nformat ascii 1.0\n", mtime=0), "one packed by gzip: unpack it"),
    ],
)
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".splat", ".glb"])
def test_what_is_no_scene_file_is_told(content: bytes, told: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"a{suffix}: not a scene file, but {told}"):
        Gaussians.load(path)


@pytest.mark.parametrize(("inside", "told"), [("a.ply", "an archive: unpack it"), ("a/data.pkl", "a checkp")])
def test_archives_and_checkpoints_are_told(inside: str, told: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.ply", "w") as packed:
        packed.writestr(inside, "ply")
    with pytest.raises(ValueError, match=told):
        Gaussians.load(tmp_path / "a.ply")


def changed(gaussians: Gaussians, path: Path, without: list[str], more: dict[str, np.ndarray]) -> Path:
    """The scene as PLY without some columns, and with others."""
    gaussians.save(path)
    rows = PlyData.read(str(path))["vertex"].data
    columns = {name: rows[name] for name in rows.dtype.names if name not in without} | more
    made = np.empty(len(rows), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        made[name] = values
    PlyData([PlyElement.describe(made, "vertex")]).write(str(path))
    return path


def test_discs_get_a_thickness(gaussians: Gaussians, tmp_path: Path) -> None:
    flat = Gaussians.load(changed(gaussians, tmp_path / "a.ply", ["scale_2"], {}))
    assert torch.equal(flat.scales[:, :2], gaussians.scales[:, :2])
    thin = gaussians.scales[:, :2].min(1).values + np.log(1e-3)
    torch.testing.assert_close(flat.scales[:, 2], thin)
    assert any("discs" in note for note in flat.notes)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_plain_colours(kind: type, gaussians: Gaussians, tmp_path: Path) -> None:
    dark = [f"f_dc_{k}" for k in range(3)] + [f"f_rest_{k}" for k in range(9)]
    white = 255 if kind is np.uint8 else 1
    colors = {
        name: np.full(40, k * white // 2).astype(kind) for k, name in enumerate(("red", "green", "blue"))
    }
    read = Gaussians.load(changed(gaussians, tmp_path / "a.ply", dark, colors))
    shown = (0.5 + SH_C0 * read.sh0[:, 0]).numpy()
    np.testing.assert_allclose(shown, np.tile([colors[n][0] / white for n in colors], (40, 1)), atol=1e-6)


def test_points_alone_are_told(tmp_path: Path) -> None:
    rows = np.zeros(
        3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    )
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(ValueError, match="it holds only points, from which `hqgs train` makes a scene"):
        Gaussians.load(tmp_path / "a.ply")


def test_a_damaged_archive_gets_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "scene.sog"
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("meta.json", "{}")
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"PK\1\2", b"PK\1\3"))  # its list of files; the end of it is found
    with pytest.raises(ValueError, match=r"scene\.sog: not a readable sog file"):
        Gaussians.load(path)
