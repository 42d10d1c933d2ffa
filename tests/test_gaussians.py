"""The start from a point cloud: against brute force and closed forms, and as neighbours lie."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from hqgs.model.gaussians import Gaussians, mean_square_distance
from hqgs.model.shapes import THINNEST, as_discs
from hqgs.scene.world import World
from tests.reference import rotation_matrices


def brute_force(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Mean squared distance of points[rows] to their 3 nearest other points."""
    p = points.astype(np.float64)
    square = ((p[rows, None] - p[None]) ** 2).sum(axis=2)
    square[np.arange(len(rows)), rows] = np.inf
    return np.sort(square, axis=1)[:, :3].mean(axis=1)


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {
        "four": rng.standard_normal((4, 3)),
        "one leaf": rng.standard_normal((64, 3)),
        "two leaves": rng.standard_normal((65, 3)),
        "plane": np.concatenate([rng.random((700, 2)), np.zeros((700, 1))], axis=1),
        "line": rng.random((300, 1)) * [1.0, 2.0, 3.0],
        "clusters": rng.standard_normal((900, 3)) * 0.01 + rng.integers(0, 3, (900, 3)),
        "outliers": np.concatenate([rng.standard_normal((800, 3)), 1e3 * rng.standard_normal((9, 3))]),
        "duplicates": np.repeat(rng.standard_normal((100, 3)), 3, axis=0),
        "far away": rng.standard_normal((300, 3)) * 0.01 + 5e3,
    }


@pytest.mark.parametrize("name", clouds())
def test_neighbour_distances_match_brute_force(name: str) -> None:
    points = clouds()[name].astype(np.float32)
    expected = brute_force(points, np.arange(len(points)))
    np.testing.assert_allclose(mean_square_distance(points), expected, rtol=1e-12)


def test_neighbour_distances_of_a_large_cloud() -> None:
    points = np.random.default_rng(2).standard_normal((30_000, 3)).astype(np.float32)
    rows = np.arange(0, len(points), 1_000)
    np.testing.assert_allclose(mean_square_distance(points)[rows], brute_force(points, rows), rtol=1e-12)


def test_from_points_activates_to_the_published_start() -> None:
    rng = np.random.default_rng(3)
    points = rng.standard_normal((50, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (50, 3), dtype=np.uint8)
    g = Gaussians.from_points(points, colors, sh_degree=2)
    assert len(g) == 50
    assert g.sh_degree == 2
    assert (g.sh0.shape, g.shN.shape) == ((50, 1, 3), (50, 8, 3))
    assert all(tensor.dtype == torch.float32 for tensor in g.named().values())
    np.testing.assert_array_equal(g.means.numpy(), points)
    np.testing.assert_array_equal(g.quats.numpy(), np.tile([1.0, 0.0, 0.0, 0.0], (50, 1)))
    np.testing.assert_allclose(g.activated_opacities().numpy(), 0.1, rtol=1e-6)
    scale = np.sqrt(brute_force(points, np.arange(50)))
    np.testing.assert_allclose(g.activated_scales().numpy(), np.tile(scale[:, None], 3), rtol=1e-6)
    shown = 0.5 / np.sqrt(np.pi) * g.sh0[:, 0].numpy() + 0.5  # the constant basis is 1 / (2 sqrt(pi))
    np.testing.assert_allclose(shown, colors / 255.0, atol=1e-6)
    assert not g.shN.any()
    assert g.means.data_ptr() != points.ctypes.data  # training must not write into the scene


def test_coincident_points_get_a_small_finite_scale() -> None:
    g = Gaussians.from_points(np.ones((200, 3), np.float32), np.zeros((200, 3), np.uint8))
    np.testing.assert_allclose(g.activated_scales().numpy(), np.sqrt(1e-7), rtol=1e-5)


def test_bad_clouds_are_refused_with_the_reason() -> None:
    points = np.zeros((9, 3), np.float32)
    colors = np.zeros((9, 3), np.uint8)
    with pytest.raises(ValueError, match=r"points has shape \[3, 3\]"):
        Gaussians.from_points(points[:3], colors[:3])
    with pytest.raises(ValueError, match=r"colors is float32 \[9, 3\], wanted uint8"):
        Gaussians.from_points(points, colors.astype(np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="sh_degree is 4"):
        Gaussians.from_points(points, colors, sh_degree=4)
    points[7, 1] = np.nan
    with pytest.raises(ValueError, match="1 rows that are not finite, the first is row 7"):
        Gaussians.from_points(points, colors)


def test_shapes_must_match() -> None:
    g = Gaussians.from_points(np.eye(4, 3, dtype=np.float32), np.zeros((4, 3), np.uint8))
    good: dict[str, Any] = g.named()
    with pytest.raises(ValueError, match=r"quats has shape \[3, 4\], wanted \[4, 4\]"):
        Gaussians(**{**good, "quats": torch.ones(3, 4)})
    with pytest.raises(ValueError, match=r"shN has shape \[4, 5, 3\]"):
        Gaussians(**{**good, "shN": torch.ones(4, 5, 3)})


def test_what_is_no_tensor_stays_with_any_copy() -> None:
    """Of `dataclasses.replace`, too: the frame, how it is rendered, what a file said."""
    made = Gaussians.from_points(np.eye(5, 3), np.zeros((5, 3), np.uint8))
    made.world, made.antialiased, made.notes = World(unit=2.0), True, ["a note"]
    made.errors = torch.arange(5.0)
    rows = torch.tensor([3, 1])
    turned = replace(made, quats=made.quats + 1)
    copies = [turned, made.detached(), as_discs(made), made.rows(rows)]
    for copy in [*copies, made.like(made.rows(rows).named())]:
        assert (copy.world, copy.antialiased, copy.notes) == (World(unit=2.0), True, ["a note"])
    assert torch.equal(copies[3].errors, torch.tensor([3.0, 1.0]))  # pyright: ignore
    assert made.like(made.rows(rows).named()).errors is None
    assert [*made.named()] == ["means", "scales", "quats", "opacities", "sh0", "shN"]


# --- Gaussians start as their neighbours lie


def started(points: np.ndarray) -> tuple[Gaussians, Gaussians]:
    """The Gaussians of a cloud as 3DGS starts, and as discs."""
    made = Gaussians.from_points(points.astype(np.float32), np.full((len(points), 3), 99, np.uint8), 1)
    return made, as_discs(made)


def axes(gaussians: Gaussians) -> torch.Tensor:
    """[N, 3, 3], the axes as columns."""
    return rotation_matrices(gaussians.quats.double())


def test_points_of_a_plane_become_discs_in_it() -> None:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    round_ones, discs = started((flat + rng.uniform(-0.2, 0.2, flat.shape) * [1, 1, 0]) @ turn.T)
    normals = axes(discs)[:, :, 2]
    torch.testing.assert_close((normals @ torch.from_numpy(turn[:, 2])).abs(), torch.ones(400).double())
    shape = (discs.scales - round_ones.scales).exp()
    torch.testing.assert_close(shape[:, 0] * shape[:, 1], torch.ones(400), rtol=1e-5, atol=0)
    torch.testing.assert_close(shape[:, 2] / shape[:, 0], torch.full((400,), THINNEST[2]), rtol=1e-5, atol=0)
    for name in ("means", "opacities", "sh0", "shN"):
        assert getattr(discs, name) is getattr(round_ones, name)


def test_points_of_a_line_become_needles_along_it() -> None:
    along = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    _, needles = started(np.linspace(0, 9, 50)[:, None] * along)
    turned = (axes(needles)[:, :, 0] @ torch.from_numpy(along)).abs()
    torch.testing.assert_close(turned, torch.ones(50).double())
    thinner = (needles.scales[:, 1:] - needles.scales[:, :1]).exp()
    torch.testing.assert_close(thinner, torch.tensor(THINNEST[1:]).expand(50, 2), rtol=1e-5, atol=0)


@pytest.mark.parametrize("count", [4, 5, 300])
def test_any_cloud_gives_finite_gaussians_of_unit_quaternions(count: int) -> None:
    points = np.random.default_rng(1).normal(size=(count, 3))
    for cloud in (points, np.ones((count, 3)), points * [1e6, 1e-6, 1]):
        _, discs = started(cloud)
        assert all(torch.isfinite(tensor).all() for tensor in discs.named().values())
        assert all(tensor.is_contiguous() for tensor in discs.named().values())
        torch.testing.assert_close(discs.quats.norm(dim=1), torch.ones(count))
        torch.testing.assert_close(torch.linalg.det(axes(discs)), torch.ones(count).double())
