"""SPZ: round trips within what it stores, files of other writers and versions, and files that lie."""

from __future__ import annotations

import gzip
import math
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_ply import random_gaussians

from hqgs.cli import main as cli
from hqgs.model.formats.spz import encode_spz, write_spz
from hqgs.model.gaussians import Gaussians
from hqgs.model.render import render_view
from hqgs.scene.scene import Camera

# The content of two files that Niantic's own C++ writer made of `golden()` without a change of frame.
NIANTIC = {
    2: "4e4753500200000002000000010c000000040000e8ff00300000c0f900000000280080e1a680599333f2707860b0a8a0"
    "bf40bf650a58c0609080a04020a0c0808080808000808080",
    3: "4e4753500300000002000000010c000000040000e8ff00300000c0f900000000280080e1a680599333f2707860b0a8a0"
    "69a595364a7a4349c0609080a04020a0c0808080808000808080",
}


def golden() -> Gaussians:
    """What the files hold, turned into the frame of this project: y and z change their signs."""
    sh = torch.zeros(2, 3, 3)  # of degree 1: y, z, x
    sh[0] = torch.tensor([[-0.5, 0.25, -0.125], [0, -0.25, 0.5], [-0.75, 0.25, 0.5]])
    sh[1, 1, 2] = 1
    return Gaussians(
        means=torch.tensor([[0.25, 1.5, -3.0], [-100.0, 0.0, -2.5]]),
        scales=torch.tensor([[-3.0, -2.5, -4.0], [1.0, 0.5, 0.0]]),
        quats=torch.tensor([[0.5, 0.5, 0.5, -0.5], [-0.1, 0.2, -0.9, -0.3]]),
        opacities=torch.tensor([0.0, 2.0]),
        sh0=torch.tensor([[[1.0, 0.0, -1.0]], [[0.5, -2.0, 3.0]]]),
        shN=sh,
    )


def in_range(n: int, sh_degree: int) -> Gaussians:
    """Random Gaussians with every value within what SPZ can hold."""
    g = random_gaussians(n, sh_degree)
    limits = {"scales": (-10.0, 5.9375), "sh0": (-3.33, 3.33), "shN": (-0.992, 0.992)}
    return Gaussians(**{k: t.clamp(*limits[k]) if k in limits else t for k, t in g.named().items()})


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angles [N] of the rotations between quaternions [N, 4]."""
    a, b = (q.double() / q.double().norm(dim=1, keepdim=True) for q in (a, b))
    b = b * torch.where((a * b).sum(dim=1) < 0, -1, 1)[:, None]
    return 4 * torch.asin((a - b).norm(dim=1) / 2)


def payload(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes())


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("sh_bits", [(8, 8), (5, 4), (1, 2)])
def test_the_stated_errors_hold(tmp_path: Path, sh_degree: int, sh_bits: tuple[int, int]) -> None:
    g = in_range(3000, sh_degree)
    g.scales[:2] = torch.tensor([[-10.0] * 3, [5.9375] * 3])
    g.quats[:3] = torch.tensor([[0.5, 0.5, 0.5, -0.5], [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1e-20, 0.0]])
    g.opacities[:2] = torch.tensor([-30.0, 30.0])
    file = write_spz(tmp_path / "a.spz", g.arrays(), sh_bits)
    assert (file.gaussians, file.left_out) == (3000, 0)
    back = Gaussians.load(tmp_path / "a.spz")
    assert back.sh_degree == sh_degree
    step = 2.0**-file.fraction
    rounding = 1e-6
    assert (back.means - g.means).abs().max() <= step / 2 + rounding
    assert (back.scales - g.scales).abs().max() <= 1 / 32 + rounding
    assert angles(back.quats, g.quats).max() <= 0.005
    change = back.activated_opacities().double() - g.activated_opacities().double()
    assert change.abs().max() <= 0.5 / 255 + rounding
    assert (back.sh0 - g.sh0).abs().max() <= 1 / 76.5 + rounding
    for part, bits in ((back.shN - g.shN)[:, :3], sh_bits[0]), ((back.shN - g.shN)[:, 3:], sh_bits[1]):
        if part.numel():
            assert 0.3 * 2.0**-bits < part.abs().max() <= 2.0**-bits + rounding
    # the bounds are no larger than they must be
    assert (back.means - g.means).abs().max() > 0.45 * step
    assert (back.scales - g.scales).abs().max() > 0.95 / 32
    assert angles(back.quats, g.quats).max() > 0.0025
    assert (back.sh0 - g.sh0).abs().max() > 0.95 / 76.5


@pytest.mark.parametrize("version", [2, 3])
def test_a_file_of_another_writer_is_read(tmp_path: Path, version: int) -> None:
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes.fromhex(NIANTIC[version])))
    back, g = Gaussians.load(tmp_path / "a.spz"), golden()
    assert torch.equal(back.means, g.means)
    assert torch.equal(back.scales, g.scales)
    assert torch.equal(back.shN, g.shN)
    assert angles(back.quats, g.quats).max() < (0.03 if version == 2 else 0.005)
    assert (back.sh0 - g.sh0).abs().max() <= 1 / 76.5
    assert (back.activated_opacities() - g.activated_opacities()).abs().max() <= 0.5 / 255 + 1e-6


def test_the_bytes_are_those_of_another_writer(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", golden().arrays())
    ours, theirs = payload(tmp_path / "a.spz"), bytes.fromhex(NIANTIC[3])
    assert ours[:13] == theirs[:13]
    assert ours[14:16] == b"\0\0"
    assert ours[16 + 18 :] == theirs[16 + 18 :]  # the positions have other bits after the point


def test_the_frame_is_turned_and_not_mirrored(tmp_path: Path) -> None:
    """The raw values, seen by a camera whose world is turned half around x, give the same picture."""
    g = in_range(40, 3)
    g.means[:] = g.means * 0.3 + torch.tensor([0.0, 0.0, 3.0])
    g.scales[:] = g.scales.clamp(-3, -1.5) + torch.linspace(0, 0.8, 3)
    write_spz(tmp_path / "a.spz", g.arrays(), (8, 8))
    data = payload(tmp_path / "a.spz")
    raw = raw_values(data)
    K = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    turn = np.diag([1.0, -1, -1, 1])
    pictures = []
    for gaussians, world in ((Gaussians.load(tmp_path / "a.spz"), np.eye(4)), (raw, turn), (g, np.eye(4))):
        camera = Camera(48, 32, K, np.eye(4) @ world)
        with torch.no_grad():
            pictures.append(render_view(gaussians, camera, 3, (0.2, 0.5, 0.8))[0])
    assert pictures[0].std() > 0.1
    assert (pictures[0] - pictures[1]).abs().max() < 1e-4
    assert (pictures[0] - pictures[2]).abs().mean() < 0.01


def raw_values(data: bytes) -> Gaussians:
    """The values of a file of version 3 in its own frame, one by one, as its documentation has it."""
    _, _, n, degree, fraction, _, _ = struct.unpack_from("<IIIBBBB", data)
    rest = (degree + 1) ** 2 - 1
    starts = 16 + n * np.cumsum([0, 9, 1, 3, 3, 4])
    g = Gaussians(
        torch.zeros(n, 3), torch.zeros(n, 3), torch.zeros(n, 4), torch.zeros(n), torch.zeros(n, 1, 3),
        torch.zeros(n, rest, 3),
    )  # fmt: skip
    for i in range(n):
        for c in range(3):
            at = starts[0] + 9 * i + 3 * c
            g.means[i, c] = int.from_bytes(data[at : at + 3], "little", signed=True) / 2**fraction
            g.sh0[i, 0, c] = (data[starts[2] + 3 * i + c] / 255 - 0.5) / 0.15
            g.scales[i, c] = data[starts[3] + 3 * i + c] / 16 - 10
            for k in range(rest):
                g.shN[i, k, c] = (data[starts[5] + 3 * (rest * i + k) + c] - 128) / 128
        alpha = data[starts[1] + i] / 255
        g.opacities[i] = math.log(alpha / (1 - alpha))
        bits = format(struct.unpack_from("<I", data, starts[4] + 4 * i)[0], "032b")
        largest = int(bits[:2], 2)
        smaller = [bits[2:12], bits[12:22], bits[22:]]
        values = [(-1 if b[0] == "1" else 1) * int(b[1:], 2) / 511 / math.sqrt(2) for b in smaller]
        values.insert(largest, math.sqrt(1 - sum(v * v for v in values)))  # x y z w
        g.quats[i] = torch.tensor([values[3], *values[:3]])
    return g


def test_what_is_out_of_range_is_clipped_and_counted(tmp_path: Path) -> None:
    g = in_range(500, 1)
    g.scales[0, 0] = -11.0
    g.sh0[1, 0] = torch.tensor([4.0, -5.0, 3.34])  # the last rounds into the range
    g.shN[2, 1] = torch.tensor([1.5, -1.5, -1.01])
    file = write_spz(tmp_path / "a.spz", g.arrays())
    assert file.clipped == {"scales": 1, "sh0": 2, "shN": 3}
    back = Gaussians.load(tmp_path / "a.spz")
    assert back.scales[0, 0] == -10
    assert torch.allclose(back.sh0[1, 0], torch.tensor([10 / 3, -10 / 3, 10 / 3]))
    assert back.shN[2, 1].tolist() == [1.0, -127 / 128, -127 / 128]  # z: the signs are turned


@pytest.mark.parametrize("scale", [0.02, 1.0, 30.0])
def test_the_bits_of_a_position_follow_the_scene(tmp_path: Path, scale: float) -> None:
    g = in_range(1000, 0)
    g.means[:] *= scale
    g.scales[:] = math.log(0.01 * scale)
    file = write_spz(tmp_path / "a.spz", g.arrays())
    assert 0.01 * scale / 128 <= 2.0**-file.fraction <= 0.01 * scale / 32
    g.means[0] = 5e3 * scale  # one far away takes bits from all
    file = write_spz(tmp_path / "a.spz", g.arrays())
    back = Gaussians.load(tmp_path / "a.spz")
    assert 5e3 * scale * 2**file.fraction < 2**23
    assert ((back.means - g.means).abs() <= 2.0**-file.fraction / 2 + 4e-3 * scale).all()


def test_a_scene_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_text("old")
    g = in_range(1000, 0)
    g.scales[:] = math.log(0.01)
    far = replace(g, means=g.means + torch.tensor([1e6, 0, 0]))
    with pytest.raises(ValueError, match=r"means: SPZ has 24 bits for a position, so 1e\+06 world units"):
        write_spz(path, far.arrays())
    with pytest.raises(ValueError, match="means: "):
        write_spz(path, replace(g, means=g.means * 1e20).arrays())
    for change in (-8.0, 11.0):
        with pytest.raises(ValueError, match="scales: the largest scale of 1,000 of 1,000 Gaussians"):
            write_spz(path, replace(g, scales=g.scales + change).arrays())
    for bits in ((0, 4), (5, 9), (5, 4, 3)):
        with pytest.raises(ValueError, match="sh_bits is "):
            write_spz(path, g.arrays(), bits)  # type: ignore[arg-type]
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.spz"]


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_no_gaussian_at_all(tmp_path: Path, sh_degree: int) -> None:
    write_spz(tmp_path / "a.spz", random_gaussians(0, sh_degree).arrays())
    back = Gaussians.load(tmp_path / "a.spz")
    assert (len(back), back.sh_degree) == (0, sh_degree)


def test_the_same_gaussians_give_the_same_bytes() -> None:
    g = in_range(100, 2)
    assert encode_spz(g.arrays()).data == encode_spz(g.arrays()).data


def damage_is_noticed(path: Path, whole: bytes, cuts: range, places: range) -> None:
    """The file cut at these lengths, with one bit of these bytes changed, and with a byte more."""
    for length in cuts:
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.spz: "):
            Gaussians.load(path)
    for place in places:
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"a\.spz: "):
            Gaussians.load(path)
    path.write_bytes(whole + b"x")
    with pytest.raises(ValueError, match=r"a\.spz: damaged: more data"):
        Gaussians.load(path)


def test_every_cut_and_every_changed_byte_of_the_end_is_noticed(tmp_path: Path) -> None:
    whole = encode_spz(in_range(3, 0).arrays()).data
    end = len(whole)
    damage_is_noticed(tmp_path / "a.spz", whole, range(0, end, 3), range(end - 8, end))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ((0x5053474F, 3, 1, 0, 12, 0, 0), "not an SPZ file: its first number"),
        ((0x5053474E, 4, 1, 0, 12, 0, 0), "SPZ version 4, wanted 2 or 3"),
        ((0x5053474E, 3, 1, 5, 12, 0, 0), "harmonics of degree 5"),
        ((0x5053474E, 3, 1, 0, 24, 0, 0), "24 fractional bits"),
        ((0x5053474E, 3, 1, 0, 12, 4, 0), "flags 0x4"),
        ((0x5053474E, 3, 4_000_000_000, 3, 12, 0, 0), "the header promises 4,000,000,000 Gaussians"),
        ((0x5053474E, 3, 9_000_000, 3, 12, 0, 0), "the header promises 9,000,000 Gaussians"),
        ((0x5053474E, 3, 2, 0, 12, 0, 0), "damaged: less data than 2 Gaussians have"),
    ],
)
def test_a_header_that_lies_is_refused_before_anything_is_allocated(
    tmp_path: Path, header: tuple[int, ...], message: str
) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(struct.pack("<IIIBBBB", *header) + bytes(20)))
    tracemalloc.start()
    with pytest.raises(ValueError, match=rf"a\.spz: {message}"):
        Gaussians.load(path)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_a_decompression_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    packer = zlib.compressobj(wbits=31)
    start = packer.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0))
    zeros = bytes(1 << 20)
    path.write_bytes(start + b"".join(packer.compress(zeros) for _ in range(64)) + packer.flush())
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a\.spz: damaged: more data than 1 Gaussians have"):
        Gaussians.load(path)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


# --- SPZ 3 and 4: the same values in two containers, another program's reader and writer, and files that lie


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


def test_version_4_of_another_writer_is_read(tmp_path: Path) -> None:
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
