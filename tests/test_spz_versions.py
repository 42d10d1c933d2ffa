"""SPZ 3 and 4: the same values in two containers, another program's reader and writer, and files that lie."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_spz import angles, damage_is_noticed, golden, in_range

from hqgs.cli import main as cli
from hqgs.model.formats.spz import encode_spz, write_spz
from hqgs.model.gaussians import Gaussians

MAGIC = 0x5053474E
RUB = torch.tensor([1.0, -1.0, -1.0])  # other programs give the file's own frame


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_both_versions_hold_the_same_values(tmp_path: Path, sh_degree: int) -> None:
    g = in_range(500, sh_degree)
    files = {v: write_spz(tmp_path / f"{v}.spz", g.arrays(), version=v) for v in (3, 4)}
    old, new = (Gaussians.load(tmp_path / f"{v}.spz").named() for v in files)
    assert all(torch.equal(old[name], new[name]) for name in old)
    assert files[4].data[:4] == b"NGSP"
    streams, table = struct.unpack_from("<BI", files[4].data, 15)
    assert (streams, table) == (6 if sh_degree else 5, 32)
    sizes = np.frombuffer(files[4].data, "<u8", 2 * streams, 32).reshape(streams, 2)
    assert 32 + 16 * streams + sizes[:, 0].sum() == len(files[4].data)
    assert sizes[:, 1].tolist() == [500 * w for w in (9, 1, 3, 3, 4, 3 * ((sh_degree + 1) ** 2 - 1)) if w]
    assert encode_spz(g.arrays(), version=4).data == files[4].data


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
@pytest.mark.parametrize("version", [3, 4])
def test_another_reader_finds_the_scene(tmp_path: Path, sh_degree: int, version: int) -> None:
    gsply = pytest.importorskip("gsply")
    g = in_range(400, sh_degree)
    file = write_spz(tmp_path / "a.spz", g.arrays(), version=version)
    theirs = gsply.read_spz(tmp_path / "a.spz")
    means = torch.from_numpy(np.array(theirs.means)) * RUB
    assert (means - g.means).abs().max() <= 0.5 * 2.0**-file.fraction + 1e-6
    quats = torch.from_numpy(np.array(theirs.quats)) * torch.tensor([1.0, *RUB])
    assert angles(quats, g.quats).max() < 0.005
    assert np.abs(theirs.scales - g.scales.numpy()).max() < 1 / 32 + 1e-6
    assert np.abs(np.reshape(theirs.sh0, (-1, 3)) - g.sh0[:, 0].numpy()).max() < 1 / 76.5 + 1e-6
    seen = torch.sigmoid(torch.from_numpy(np.ravel(theirs.opacities)))
    assert (seen - g.activated_opacities()).abs().max() < 0.5 / 255 + 1e-6
    if sh_degree:  # functions odd in y z change their signs: degree 1 is y, z, x
        rest = np.reshape(theirs.shN, (400, -1, 3))[:, :3] * np.array([-1, -1, 1])[:, None]
        assert np.abs(rest - g.shN[:, :3].numpy()).max() < 2**-8 + 1e-6


def test_a_file_of_another_writer_is_read(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    g = golden()
    g.means[:] = g.means * RUB
    theirs = gsply.GSData(
        means=g.means.numpy(),
        scales=g.scales.numpy(),
        quats=(g.quats * torch.tensor([1.0, *RUB])).numpy(),
        opacities=g.opacities.numpy(),
        sh0=g.sh0[:, 0].numpy(),
        shN=(g.shN * torch.tensor([-1.0, -1.0, 1.0])[:, None]).numpy(),
    )
    gsply.write_spz(tmp_path / "a.spz", theirs, version=4)
    back = Gaussians.load(tmp_path / "a.spz")
    assert torch.equal(back.means, golden().means)
    assert torch.equal(back.scales, g.scales)
    assert torch.equal(back.shN, g.shN)
    assert angles(back.quats, g.quats).max() < 0.005


def test_the_command_line_writes_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    in_range(300, 2).save(tmp_path / "a.ply")
    for version in ("3", "4"):
        out = str(tmp_path / f"{version}.spz")
        assert cli.main(["export", str(tmp_path / "a.ply"), "--out", out, "--spz-version", version]) == 0
    assert [(tmp_path / f"{v}.spz").read_bytes()[:2] for v in (3, 4)] == [b"\x1f\x8b", b"NG"]
    assert (
        cli.main(["export", str(tmp_path / "a.ply"), "--out", str(tmp_path / "b.spz"), "--spz-version", "5"])
        == 2
    )
    assert "spz_version is 5, wanted one of: 3, 4" in capsys.readouterr().err


# --- files that lie


def header(**changes: Any) -> bytes:
    h = SimpleNamespace(
        **{"version": 4, "n": 1, "degree": 0, "fraction": 12, "flags": 0, "streams": 5, "table": 32} | changes
    )
    start = (MAGIC, h.version, h.n, h.degree, h.fraction, h.flags, h.streams, h.table)
    return struct.pack("<IIIBBBBI12x", *start)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 5}, "SPZ version 5, wanted 4"),
        ({"version": 3}, "damaged: more data than 1 Gaussians have"),
        ({"degree": 5}, "harmonics of degree 5"),
        ({"fraction": 24}, "24 fractional bits"),
        ({"flags": 4}, "flags 0x4"),
        ({"streams": 6}, "the header promises 6 arrays at 32, wanted 5"),
        ({"table": 20}, "the header promises 5 arrays at 20"),
        ({"n": 4_000_000_000}, "the header promises 4,000,000,000 Gaussians"),
        ({"n": 9_000_000, "degree": 3, "streams": 6}, "the header promises 9,000,000 Gaussians"),
        ({}, "damaged: less data than 1 Gaussians have"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    (tmp_path / "a.spz").write_bytes(header(**changes) + bytes(16 * 6))
    with pytest.raises(ValueError, match=rf"a\.spz: {message}"):
        Gaussians.load(tmp_path / "a.spz")


def test_every_cut_and_every_changed_byte_of_an_array_is_noticed(tmp_path: Path) -> None:
    whole = encode_spz(in_range(3, 0).arrays(), version=4).data
    damage_is_noticed(tmp_path / "a.spz", whole, range(len(whole)), range(32, len(whole)))


def test_a_frame_that_holds_more_is_not_unpacked(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    whole = encode_spz(in_range(3, 0).arrays(), version=4).data
    sizes = np.frombuffer(whole, "<u8", 10, 32).reshape(5, 2).copy()
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 28))
    rest = whole[32 + 80 + int(sizes[0, 0]) :]
    sizes[0, 0] = len(bomb)
    (tmp_path / "a.spz").write_bytes(whole[:32] + sizes.tobytes() + bomb + rest)
    with pytest.raises(ValueError, match=r"a\.spz: damaged: more data than 3 Gaussians have"):
        Gaussians.load(tmp_path / "a.spz")
