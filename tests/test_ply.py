"""PLY files: exact round trips, the layout byte by byte, and files that lie."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

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
