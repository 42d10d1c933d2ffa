"""The start from a point cloud, against brute force and closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from hqgs.model.gaussians import Gaussians, mean_square_distance
from hqgs.model.shapes import as_discs, enlarge
from hqgs.scene.world import World


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
    copies = [turned, made.detached(), as_discs(made), enlarge(made, torch.ones(5)), made.rows(rows)]
    for copy in [*copies, made.like(made.rows(rows).named())]:
        assert (copy.world, copy.antialiased, copy.notes) == (World(unit=2.0), True, ["a note"])
    assert torch.equal(copies[4].errors, torch.tensor([3.0, 1.0]))  # pyright: ignore
    assert made.like(made.rows(rows).named()).errors is None
    assert [*made.named()] == ["means", "scales", "quats", "opacities", "sh0", "shN"]
