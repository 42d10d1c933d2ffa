"""What nobody asks for is not done: told by what is made, never by times."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from scenes import GaussianScene, random_scene
from tiny_scene import tiny_config, tiny_scene
from torch import Tensor

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


def image(s: GaussianScene) -> Tensor:
    return hqgs.rasterization(**s.arguments())[0]


@contextmanager
def seen(names: Sequence[str], sizes_of: Callable[[Any, Any], list[int]]) -> Iterator[list[int]]:
    """What `sizes_of` says of the arguments and the results of these functions of the binding."""
    sizes = list[int]()

    def watched(function: Callable[..., Any], *arguments: Any) -> Any:
        found = function(*arguments)
        sizes.extend(sizes_of(arguments, found))
        return found

    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            patch.setattr(_rust, name, partial(watched, getattr(_rust, name)))
        yield sizes


def made() -> AbstractContextManager[list[int]]:
    """Sizes of the arrays that backward passes make."""
    names = "project_backward", "composite_backward"
    return seen(names, lambda _, found: [array.size for array in found if array is not None])


def moved() -> AbstractContextManager[list[int]]:
    """How many numbers of each parameter Adam moves."""
    return seen(
        ["adam_steps"],
        lambda arguments, _: [
            param.size if used is None else param.size // param.shape[1] * used
            for param, *_, used in arguments[0]
        ],
    )


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


def test_tiles_and_blocks_without_a_cotangent_give_nothing() -> None:
    """The gradients are those of the whole image whose other cotangents are next to nothing."""
    masked, tiny = scene(*ALL), scene(*ALL)
    mask = torch.zeros(HEIGHT, WIDTH, 1)
    mask[:20, :32] = 1  # two tiles, and the upper row of blocks of the two below them
    (image(masked)[0] * mask).sum().backward()
    (image(tiny)[0] * (mask + 1e-30 * (1 - mask))).sum().backward()
    for name in ALL:
        a, b = (getattr(x, name).grad for x in (masked, tiny))
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-25)


def test_hidden_gaussians_get_no_gradient() -> None:
    front, behind = one_gaussian_at(40, 24, n=16), one_gaussian_at(40, 24, n=64)
    s = replace(front, **{name: torch.cat([getattr(front, name), getattr(behind, name)]) for name in ALL})
    s.opacities[:16] = 0.99
    s.scales[:16] = 0.5
    s.means[:16, 2] = 1.0 + 0.01 * torch.arange(16)
    s.means[:16, :2] = 0
    s = s.with_grad(*ALL)
    image(s).sum().backward()
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
    loss = image(s).sum()
    with made() as sizes:
        loss.backward()
    assert sum(sizes) == numbers
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
        with moved() as numbers:
            part.step()
        expected.append(sum(numbers) == 50 * used * 3)
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
        with moved() as numbers:
            trainer.step()
        assert sum(numbers) == n * (3 + 3 + 4 + 1 + 3 * (degree + 1) ** 2)
        grad = trainer.gaussians.shN.grad
        assert (grad is None) == (degree == 0)
        assert trainer.state.optimizer.state[trainer.gaussians.shN]["step"] == trainer.iteration
