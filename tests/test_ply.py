"""PLY files: exact round trips, the layout byte by byte, those of other programs, and files that lie."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

import hqgs
from hqgs.base.ply import read_vertices
from hqgs.model.gaussians import Gaussians


def random_gaussians(n: int = 7, sh_degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(n + sh_degree)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    rest = (sh_degree + 1) ** 2 - 1
    return Gaussians(normal(n, 3), normal(n, 3), normal(n, 4), normal(n), normal(n, 1, 3), normal(n, rest, 3))


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_round_trip_is_exact(tmp_path: Path, sh_degree: int) -> None:
    g = random_gaussians(sh_degree=sh_degree)
    g.means[0] = torch.tensor([1e-42, -0.0, 3e38])  # a denormal, a signed zero, nearly the largest float
    assert g.save(tmp_path / "a.ply") == 0
    back = Gaussians.load(tmp_path / "a.ply")
    for name, tensor in g.named().items():
        assert torch.equal(back.named()[name].view(torch.int32), tensor.view(torch.int32)), name


def test_layout_is_that_of_3dgs(tmp_path: Path) -> None:
    g = random_gaussians(n=2, sh_degree=1)
    g.save(tmp_path / "a.ply")
    header, _, data = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    expected = ["ply", "format binary_little_endian 1.0", "comment hqgs scene", "element vertex 2"]
    assert header.decode().split("\n")[:-1] == expected + [f"property float {name}" for name in names]
    rows = np.frombuffer(data, "<f4").reshape(2, len(names))
    for i, row in enumerate(rows):
        value = dict(zip(names, row, strict=True))
        assert [value[n] for n in ("x", "y", "z")] == g.means[i].tolist()
        assert [value[f"f_dc_{c}"] for c in range(3)] == g.sh0[i, 0].tolist()
        for k in range(3):  # coefficient
            for c in range(3):  # channel: all red coefficients first
                assert value[f"f_rest_{c * 3 + k}"] == g.shN[i, k, c].item()
        assert value["opacity"] == g.opacities[i].item()
        assert [value[f"scale_{c}"] for c in range(3)] == g.scales[i].tolist()
        assert [value[f"rot_{c}"] for c in range(4)] == g.quats[i].tolist()


def test_rows_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    g = random_gaussians()
    g.scales[2, 1] = torch.inf
    g.shN[5, 3, 0] = torch.nan
    assert g.save(tmp_path / "a.ply") == 2
    kept = torch.tensor([0, 1, 3, 4, 6])
    assert torch.equal(Gaussians.load(tmp_path / "a.ply").means, g.means[kept])


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_a_count_that_the_file_cannot_hold_is_refused_before_it_is_allocated(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "a.ply"
    random_gaussians().save(path)
    data = path.read_bytes().replace(b"element vertex 7", b"element vertex 70000000000")
    path.write_bytes(data.replace(b"binary_little_endian", kind.encode()))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a\.ply: the header promises 4130000000000 values"):
        Gaussians.load(path)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_every_cut_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    random_gaussians(n=2, sh_degree=0).save(path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 5):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.ply"):
            Gaussians.load(path)


# --- Scenes as 3DGS, gsplat and Brush write them, and odd but legal files, byte by byte with `struct`


POSITION = ["x", "y", "z"]
NORMAL = ["nx", "ny", "nz"]
DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALE = ["scale_0", "scale_1", "scale_2"]
ROT = ["rot_0", "rot_1", "rot_2", "rot_3"]
CODES = {"float": "f", "double": "d", "uchar": "B", "int": "i"}


def rest(degree: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]


def layout(program: str, degree: int) -> tuple[list[str], list[str]]:
    """The order of the properties, and the comments."""
    if program == "3dgs":
        return [*POSITION, *NORMAL, *DC, *rest(degree), "opacity", *SCALE, *ROT], []
    if program == "gsplat":
        return [*POSITION, *DC, *rest(degree), "opacity", *SCALE, *ROT], []
    comments = ["Exported from Brush", "Vertical axis: y", f"SH degree: {degree}", "SplatRenderMode: default"]
    return [*POSITION, *SCALE, "opacity", *ROT, *DC, *rest(degree)], comments


def values(names: Sequence[str], count: int = 3) -> list[dict[str, float]]:
    """A number of its own for each property and row, exact in 32 bits."""
    return [{name: (7 * row + 1) / 8 + k / 64 for k, name in enumerate(names)} for row in range(count)]


def write(
    path: Path,
    rows: list[dict[str, float]],
    names: Sequence[str],
    comments: Sequence[str] = (),
    kind: str = "binary_little_endian",
    types: dict[str, str] | None = None,
) -> Path:
    """A PLY file with these properties, in this order."""
    types = {name: "float" for name in names} | (types or {})
    head = ["ply", f"format {kind} 1.0", *(f"comment {text}" for text in comments)]
    head += [
        f"element vertex {len(rows)}",
        *(f"property {types[name]} {name}" for name in names),
        "end_header",
    ]
    data = "\n".join(head).encode() + b"\n"
    for row in rows:
        if kind == "ascii":
            data += " ".join(repr(row[name]) for name in names).encode() + b"\n"
        else:
            order = "<" if kind == "binary_little_endian" else ">"
            data += b"".join(struct.pack(order + CODES[types[name]], row[name]) for name in names)
    path.write_bytes(data)
    return path


def check(gaussians: hqgs.Gaussians, rows: list[dict[str, float]], degree: int) -> None:
    """Every value at its place."""
    higher = (degree + 1) ** 2 - 1
    assert (len(gaussians), gaussians.sh_degree) == (len(rows), degree)
    for i, row in enumerate(rows):
        assert gaussians.means[i].tolist() == [row[name] for name in POSITION]
        assert gaussians.scales[i].tolist() == [row[name] for name in SCALE]
        assert gaussians.quats[i].tolist() == [row[name] for name in ROT]
        assert gaussians.opacities[i].item() == row["opacity"]
        for c in range(3):
            assert gaussians.sh0[i, 0, c].item() == row[f"f_dc_{c}"]
            for k in range(higher):
                assert gaussians.shN[i, k, c].item() == row[f"f_rest_{c * higher + k}"]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("program", ["3dgs", "gsplat", "brush"])
def test_files_of_other_programs(program: str, degree: int, tmp_path: Path) -> None:
    names, comments = layout(program, degree)
    rows = values(names)
    gaussians = hqgs.Gaussians.load(write(tmp_path / "point_cloud.ply", rows, names, comments))
    check(gaussians, rows, degree)
    gaussians.save(tmp_path / "ours.ply")
    check(hqgs.Gaussians.load(tmp_path / "ours.ply"), rows, degree)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_any_order_any_number_type_and_more_properties(kind: str, tmp_path: Path) -> None:
    names = [*layout("3dgs", 2)[0], "red", "label", "f_other"]
    names = [names[k] for k in np.random.default_rng(2).permutation(len(names))]
    rows = values(names)
    for row in rows:
        row |= {"red": 200, "label": -7}
    types = {"red": "uchar", "label": "int", "x": "double", "opacity": "double", "f_rest_3": "double"}
    check(hqgs.Gaussians.load(write(tmp_path / "a.ply", rows, names, (), kind, types)), rows, 2)


def test_other_elements_are_passed_by(tmp_path: Path) -> None:
    names, _ = layout("gsplat", 1)
    rows = values(names)
    data = write(tmp_path / "a.ply", rows, names).read_bytes()
    head, _, body = data.partition(b"element vertex")
    head += b"element camera 2\nproperty double fov\nelement vertex"
    body = body.replace(b"end_header\n", b"element face 1\nproperty list uchar int corners\nend_header\n")
    top, _, values_ = body.partition(b"end_header\n")
    cameras, face = struct.pack("<2d", 0.5, 0.7), struct.pack("<B3i", 3, 0, 1, 2)
    (tmp_path / "b.ply").write_bytes(head + top + b"end_header\n" + cameras + values_ + face)
    check(hqgs.Gaussians.load(tmp_path / "b.ply"), rows, 1)


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    names, _ = layout("3dgs", 1)
    rows = values(names)
    path = tmp_path / "bad.ply"

    def refused(message: str) -> None:
        with pytest.raises(ValueError, match=rf"bad\.ply: {message}"):
            hqgs.Gaussians.load(path)

    write(path, rows, [name for name in names if name not in ("scale_1", "rot_3")])
    refused("not a 3DGS scene, these properties are missing: scale_1, rot_3")
    write(path, [row | {"opacity": float("nan")} for row in rows], names)
    refused("none of its 3 rows is finite")
    for value, types in ((float("inf"), {}), (1e300, {"f_rest_5": "double"})):
        rows[2]["f_rest_5"] = value
        write(path, rows, names, types=types)
        read = hqgs.Gaussians.load(path)
        assert read.notes == ["1 of 3 Gaussians hold NaN or Inf and were left out"]
        check(read, rows[:2], 1)
    many = [*names, *(f"f_rest_{i}" for i in range(9, 72))]  # degree 4, which Brush can write
    write(path, values(many), many)
    read = hqgs.Gaussians.load(path)
    assert (read.sh_degree, read.notes) == (3, ["its harmonics of degree 4 were left out"])
    last = [values(many)[1][f"f_rest_{24 * channel + 14}"] for channel in range(3)]
    np.testing.assert_allclose(read.shN[1, 14], last)
    odd = [*names, *(f"f_rest_{i}" for i in range(9, 30))]
    write(path, values(odd), odd)
    refused(r"30 f_rest_\* properties, wanted one of \[0, 9, 24, 45\]")
    data = write(path, values(names), names).read_bytes()
    path.write_bytes(data.replace(b"property float opacity", b"property list uchar float opacity"))
    refused("")
    path.write_bytes(data.replace(b"float rot_1", b"float rot_0"))
    refused("not a readable PLY file")
    path.write_bytes(data.replace(b"element vertex", b"element points"))
    refused("a PLY file without the element vertex")


def test_a_foreign_scene_renders(tmp_path: Path) -> None:
    """One Gaussian in front of a camera: its colour is 1/2 + C0 f_dc at the centre, as 3DGS has it."""
    names, comments = layout("brush", 0)
    row = dict.fromkeys(names, 0.0) | {"z": 2.0, "opacity": 12.0, "rot_0": 3.0, "f_dc_0": 1.0, "f_dc_2": -1.0}
    row |= dict.fromkeys(SCALE, -0.5)
    gaussians = hqgs.Gaussians.load(write(tmp_path / "a.ply", [row], names, comments))
    K = np.array([[40.0, 0, 16.5], [0, 40, 12.5], [0, 0, 1]])
    image = gaussians.render(hqgs.Camera(33, 25, K, np.eye(4)))
    c0 = 0.5 / np.sqrt(np.pi)
    wanted = 0.99 * torch.tensor([0.5 + c0, 0.5, 0.5 - c0])  # alpha ends at 0.99
    torch.testing.assert_close(image[12, 16], wanted, rtol=0, atol=1e-5, check_dtype=False)


@pytest.mark.parametrize("lengths", [False, True])
def test_shares_and_lengths_are_told_from_logits_and_logarithms(tmp_path: Path, lengths: bool) -> None:
    names, _ = layout("gsplat", 0)
    rng = np.random.default_rng(0)
    rows = [dict.fromkeys(names, 0.5) | {"opacity": share} for share in rng.uniform(0, 1, 200)]
    for row in rows:
        row |= dict.fromkeys(SCALE, 0.02 if lengths else -4.0)
    found = hqgs.Gaussians.load(write(tmp_path / "shares.ply", rows, names))
    shares = torch.tensor([row["opacity"] for row in rows], dtype=torch.float32)
    torch.testing.assert_close(torch.sigmoid(found.opacities), shares, rtol=0, atol=1e-6)
    assert torch.allclose(found.scales, torch.full((200, 3), np.log(0.02) if lengths else -4.0))
    for row in rows:
        row["opacity"] = 9 * row["opacity"] - 3
    logits = hqgs.Gaussians.load(write(tmp_path / "logits.ply", rows, names)).opacities
    assert float(logits.max()) > 5  # as they stand


@pytest.mark.parametrize("code", ["utf-8", "latin-1"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_comments_in_any_letters(kind: str, code: str, tmp_path: Path) -> None:
    names, _ = layout("gsplat", 1)
    rows = values(names)
    data = write(tmp_path / "a.ply", rows, names, ["see end_header of X"], kind).read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"X", "Schön: Küche".encode(code), 1))
    check(hqgs.Gaussians.load(tmp_path / "b.ply"), rows, 1)
    mapped = isinstance(read_vertices(tmp_path / "b.ply"), np.memmap)  # else large files take minutes
    assert mapped == (kind != "ascii")
