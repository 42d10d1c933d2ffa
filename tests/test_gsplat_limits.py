"""What code written for gsplat meets where hqgs ends: an error that names it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import hqgs
from hqgs.model.rasterization import RasterizationMeta


def shot(**options: object) -> tuple[Tensor, Tensor, RasterizationMeta, Tensor]:
    generator = torch.Generator().manual_seed(0)
    means = (torch.randn(20, 3, generator=generator) + torch.tensor([0.0, 0.0, 5.0])).requires_grad_()
    image, alpha, meta = hqgs.rasterization(
        means,
        torch.randn(20, 4, generator=generator),
        torch.full((20, 3), 0.1),
        torch.full((20,), 0.5),
        torch.rand(20, 3, generator=generator),
        torch.eye(4)[None],
        torch.tensor([[[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]]),
        48,
        36,
        **options,  # pyright: ignore[reportArgumentType]
    )
    return image, alpha, meta, means


@pytest.mark.parametrize("power", [1, 2])
def test_second_derivatives_are_refused(power: int) -> None:
    """Of a loss whose own derivative is constant too: there a penalty on the gradient did nothing."""
    image, _, _, means = shot()
    loss = image.pow(power).mean()
    (gradient,) = torch.autograd.grad(loss, means, create_graph=True)
    assert gradient.requires_grad
    with pytest.raises(RuntimeError, match="first derivatives alone"):
        (loss + gradient.square().sum()).backward()


def test_a_gradient_with_a_graph_is_that_without() -> None:
    image, _, _, means = shot()
    loss = image.square().mean()
    (without,) = torch.autograd.grad(loss, means, retain_graph=True)
    (with_graph,) = torch.autograd.grad(loss, means, create_graph=True)
    assert without.abs().max() > 0
    assert torch.equal(with_graph.detach(), without)
    assert not without.requires_grad


@pytest.mark.parametrize("packed", [True, False])
def test_tile_lists_are_refused_by_name(packed: bool) -> None:
    _, _, meta, _ = shot(packed=packed)
    for name in ("isect_offsets", "flatten_ids", "tiles_per_gauss", "isect_ids"):
        assert name in (hqgs.rasterization.__doc__ or "")
        with pytest.raises(KeyError, match=f"{name}: hqgs returns no tile lists"):
            meta[name]  # pyright: ignore
    assert meta.get("isect_offsets") is None
