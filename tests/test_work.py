"""What nobody asks for is not done: told by counts, never by times."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from scenes import GaussianScene, random_scene
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor
from work_counts import WorkCounts, work_counts

import hqgs
from hqgs import _rust
from hqgs.training.adam import Adam
from hqgs.training.config import DensifyConfig
from hqgs.training.trainer import Trainer

WIDTH, HEIGHT = 80, 48  # 5 x 3 tiles
N = 300
ALL = ("means", "quats", "scales", "opacities", "colors")


def scene(*grads: str, **changes: Any) -> GaussianScene:
    settings = {"seed": 3, "dtype": torch.float32, "largest": 0.1} | changes
    return random_scene(N, WIDTH, HEIGHT, **settings).with_grad(*grads)


def forward(s: GaussianScene, **arguments: Any) -> tuple[Tensor, Tensor, WorkCounts]:
    """Image, alphas and the work that they took."""
    with work_counts() as counts:
        image, alphas, _ = hqgs.rasterization(**s.arguments(**arguments))
    return image, alphas, counts


def backward(loss: Tensor) -> WorkCounts:
    with work_counts() as counts:
        loss.backward()
    return counts


def one_gaussian_at(x: float, y: float, n: int = 1) -> GaussianScene:
    """N small Gaussians that all project to the pixel (x, y)."""
    K = torch.tensor([[50.0, 0, 40.0], [0, 50.0, 24.0], [0, 0, 1]])
    return GaussianScene(
        means=torch.tensor([[(x - 40) / 50 * 2, (y - 24) / 50 * 2, 2.0]]).repeat(n, 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.01),
        opacities=torch.full((n,), 0.5),
        colors=torch.ones(n, 3),
        viewmats=torch.eye(4)[None],
        Ks=K[None],
        backgrounds=torch.zeros(1, 3),
        width=WIDTH,
        height=HEIGHT,
        sh_degree=None,
    )


def test_counts_are_those_of_meta_and_only_of_the_block() -> None:
    s = scene(*ALL)
    with work_counts() as outer:
        _, _, meta = hqgs.rasterization(**s.arguments())
        with work_counts() as inner:
            image, _, _ = hqgs.rasterization(**s.arguments())
    image.sum().backward()  # outside
    assert (inner.pairs, inner.blocks, inner.changed_blocks) == meta["work"]
    assert outer.pairs == 2 * inner.pairs
    assert inner.gaussians == N
    assert 0 < inner.projected < N
    assert inner.projected == int((meta["radii"][0] > 0).all(1).sum())
    assert 0 < inner.blended <= 16 * inner.changed_blocks
    assert inner.backward_blocks == inner.gradient_arrays == 0


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("D", 1), ("RGB+D", 4)])
def test_channels_that_are_not_asked_for_are_not_composited(mode: str, channels: int) -> None:
    assert forward(scene(), render_mode=mode, backgrounds=None)[2].channels == channels


def test_alpha_has_a_cotangent_only_where_it_is_used() -> None:
    image, alphas, _ = forward(scene(*ALL))
    assert backward(image.sum()).alpha_cotangents == 0
    image, alphas, counts = forward(scene(*ALL))
    used = backward(image.sum() + alphas.sum()).alpha_cotangents
    assert 0 < used <= 16 * 16 * counts.tiles


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("apart", [False, True])
def test_bands_above_the_degree_are_not_evaluated(degree: int, apart: bool) -> None:
    s = scene(*ALL, sh_degree=3, hidden=0.0)
    bands = (degree + 1) ** 2
    colors = (s.colors[:, :1], s.colors[:, 1:]) if apart else s.colors
    image, _, counts = forward(s, colors=colors, sh_degree=degree)
    assert 0 < counts.harmonics <= bands * N
    assert counts.harmonics % bands == 0
    after = backward(image.square().sum())
    assert 0 < after.backward_harmonics <= counts.harmonics
    assert s.colors.grad is not None
    assert s.colors.grad[:, :bands].any()
    assert not s.colors.grad[:, bands:].any()


@pytest.mark.parametrize(
    ("names", "degree", "kept"),
    [((), 3, False), (("opacities",), 3, False), (ALL, 0, False), (("colors",), 1, True), (ALL, 3, True)],
)
def test_slopes_of_the_colours_are_kept_for_a_gradient_alone(
    names: tuple[str, ...], degree: int, kept: bool
) -> None:
    s = scene(*names, sh_degree=3)
    counts = forward(s, sh_degree=degree)[2]
    assert counts.projected > 0
    assert counts.slopes * (degree + 1) ** 2 == (counts.harmonics if kept else 0)
    with torch.no_grad():
        assert forward(s, sh_degree=degree)[2].slopes == 0


def test_harmonics_of_culled_gaussians_are_not_evaluated() -> None:
    s = scene(sh_degree=2)
    s.viewmats[0, 2, 3] -= 1000  # everything is behind the camera
    counts = forward(s)[2]
    assert counts.gaussians == N
    assert counts.projected == counts.harmonics == counts.slopes == 0
    assert counts.pairs == counts.tiles == counts.blocks == 0


def test_gaussians_outside_the_frustum_make_no_pairs() -> None:
    inside = one_gaussian_at(40, 24, n=3)
    shift = torch.tensor([[0.0, 0, 0], [100, 0, 0], [0, 0, -10]])  # stays, to the side, behind
    counts = forward(replace(inside, means=inside.means + shift))[2]
    assert (counts.gaussians, counts.projected) == (3, 1)
    assert (counts.pairs, counts.blocks) == (
        forward(one_gaussian_at(40, 24))[2].pairs,
        forward(one_gaussian_at(40, 24))[2].blocks,
    )


def test_tiles_without_gaussians_do_nothing() -> None:
    s = one_gaussian_at(8, 8).with_grad(*ALL, "backgrounds")
    image, _, counts = forward(s)
    assert (counts.tiles, counts.pairs) == (1, 1)
    after = backward(image.sum())
    assert (after.backward_tiles, after.skipped_tiles) == (1, 0)
    assert after.backward_blocks == counts.blocks


def test_tiles_and_blocks_without_a_cotangent_are_skipped() -> None:
    whole, masked = scene(*ALL), scene(*ALL)
    image, _, counts = forward(whole)
    after = backward(image.sum())
    assert counts.tiles == after.backward_tiles == 15
    assert (after.skipped_tiles, after.skipped_blocks) == (0, 0)
    assert after.backward_blocks == counts.blocks

    mask = torch.zeros(HEIGHT, WIDTH, 1)
    mask[:20, :32] = 1  # two tiles, and the upper row of blocks of the two below them
    image, _, _ = forward(masked)
    after = backward((image[0] * mask).sum())
    assert (after.backward_tiles, after.skipped_tiles) == (4, 11)
    assert after.backward_blocks + after.skipped_blocks == counts.blocks
    rest = backward((forward(scene(*ALL))[0][0] * (1 - mask)).sum())
    assert (rest.backward_tiles, rest.skipped_tiles) == (13, 2)
    assert rest.backward_blocks == after.skipped_blocks
    # The gradients are those of the whole image whose other cotangents are next to nothing.
    tiny = scene(*ALL)
    image, _, _ = forward(tiny)
    after = backward((image[0] * (mask + 1e-30 * (1 - mask))).sum())
    assert after.skipped_tiles == 0
    for name in ALL:
        a, b = (getattr(x, name).grad for x in (masked, tiny))
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-25)


def test_hidden_gaussians_are_not_differentiated() -> None:
    """Those behind opaque ones get zero gradients without arithmetic, in groups of 16."""
    front, behind = one_gaussian_at(40, 24, n=16), one_gaussian_at(40, 24, n=64)
    s = replace(front, **{name: torch.cat([getattr(front, name), getattr(behind, name)]) for name in ALL})
    s.opacities[:16] = 0.99
    s.scales[:16] = 0.5
    s.means[:16, 2] = 1.0 + 0.01 * torch.arange(16)
    s.means[:16, :2] = 0
    s = s.with_grad(*ALL)
    image, _, counts = forward(s)
    assert counts.projected == 80
    assert backward(image.sum()).backward_gaussians == 16
    for name in ALL:
        grad = getattr(s, name).grad
        assert grad[:16].any()
        assert not grad[16:].any()


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("colors",), 9 * N + 3 * N),  # of the harmonics, and of the colours that they give
        (("opacities",), N + 6 * N),  # its own, and of what the compositor reads: 2 + 3 + 1
        (("means", "scales"), 2 * 3 * N + 6 * N + 3 * N),
        (ALL, (3 + 4 + 3 + 1 + 12) * N + 6 * N + 3 * N),
    ],
)
def test_only_what_requires_a_gradient_gets_an_array(names: tuple[str, ...], numbers: int) -> None:
    s = scene(*names, sh_degree=0 if names == ("colors",) else 1, seed=5)
    s = replace(s, colors=s.colors[:, : 3 if names == ("colors",) else 4].detach())
    s = s.with_grad(*names)
    image, _, _ = forward(s)
    counts = backward(image.sum())
    assert counts.gradient_numbers == numbers
    assert (counts.backward_gaussians == 0) == (names == ("colors",))
    assert (counts.backward_harmonics == 0) == (names == ("opacities",))
    for name, tensor in s.tensors().items():
        assert (tensor.grad is not None) == (name in names)


@pytest.mark.parametrize("enabled", [False, True])
def test_nothing_is_kept_without_gradients(enabled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only an image that can be differentiated holds the tile lists and the projection."""
    kept: list[Any] = []

    def keep(function: Callable[..., Any], *args: Any) -> Any:
        out = function(*args)
        kept.append(out[0])
        return out

    for name in ("project_forward", "composite_forward"):
        monkeypatch.setattr(_rust, name, partial(keep, getattr(_rust, name)))
    with torch.set_grad_enabled(enabled):
        image, alphas, meta = hqgs.rasterization(**scene(*ALL).arguments())
    assert (image.grad_fn is not None) == enabled
    assert len(kept) == 2
    for i in range(2):
        others = sys.getrefcount(kept[i]) - 2  # the list and the argument
        assert (others > 0) == enabled
    del image, alphas, meta


def test_adam_leaves_out_what_is_not_used() -> None:
    """Bit for bit what it does with gradients of 0, the step included."""
    torch.manual_seed(0)
    start = torch.randn(50, 15, 3)
    params = [start.clone().requires_grad_() for _ in range(2)]
    whole, part = (Adam([param], lr=0.01, eps=1e-15) for param in params)
    expected = []
    for used in (0, 0, 3, 3, 8, 15):
        grad = torch.zeros(50, 15, 3)
        grad[:, :used] = torch.randn(50, used, 3)
        params[0].grad = grad
        params[1].grad = grad.clone() if used else None
        part.param_groups[0]["used"] = used
        whole.step()
        with work_counts() as counts:
            part.step()
        expected.append(counts.adam_numbers == 50 * used * 3)
        for a, b in zip(whole.state[params[0]].values(), part.state[params[1]].values(), strict=True):
            assert torch.equal(a, b)
        assert params[0].detach().numpy().tobytes() == params[1].detach().numpy().tobytes()
    assert all(expected)


def test_a_part_that_is_not_there_is_refused() -> None:
    param = torch.ones(4, 3, requires_grad=True)
    param.grad = torch.ones(4, 3)
    with pytest.raises(ValueError, match=r"used: cannot update 4 columns of \[4, 3\]"):
        Adam([{"params": [param], "used": 4}]).step()


def test_training_leaves_out_the_harmonics_above_its_degree() -> None:
    config = tiny_config(sh_interval=2, densify=DensifyConfig(stop=0))
    trainer = Trainer(tiny_scene(), config)
    n = len(trainer.gaussians)
    for degree in (0, 1, 1, 2, 2, 3, 3):
        with work_counts() as counts:
            trainer.step()
        numbers = 3 + 3 + 4 + 1 + 3 * (degree + 1) ** 2
        assert counts.adam_numbers == numbers * n
        assert counts.harmonics == counts.gaussians * (degree + 1) ** 2
        grad = trainer.gaussians.shN.grad
        assert (grad is None) == (degree == 0)
        assert trainer.state.optimizer.state[trainer.gaussians.shN]["step"] == trainer.iteration
