"""Scene files as people have them: read by what they hold, or one sentence says what they are."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from hqgs.cli.main import main
from hqgs.model.constants import SH_C0
from hqgs.model.gaussians import Gaussians


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
