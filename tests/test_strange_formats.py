"""Scene files and arguments at their edges: logits like shares, frames applied once, integers, nothing."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import hqgs
from hqgs.model.formats import gltf
from hqgs.model.formats.arrays import curve_order


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
