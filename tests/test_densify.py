"""Growth, pruning and resets on constructed cases, and the optimizer's state row by row."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hqgs.model.gaussians import Gaussians
from hqgs.training.adam import Adam, reset_opacities
from hqgs.training.config import DensifyConfig, TrainConfig
from hqgs.training.densify import Densification, Densifier, quats_to_matrices

SIZE = 100  # pixels: a gradient of g per pixel counts as 50 g
CONFIG = DensifyConfig(start=0, stop=1_000, every=10, reset_every=35)
THRESHOLD = CONFIG.grad_threshold
CLONED, SPLIT, KEPT = 0.005, 0.05, 0.02  # scales; with extent 1 the border between the first two is 0.01


def make(scales: list[float], opacity: float = 0.5) -> tuple[Gaussians, Adam]:
    """One Gaussian per scale, all tensors distinct by row; the moments of row i are all i + 1."""
    n = len(scales)
    row = torch.arange(n, dtype=torch.float32)
    gaussians = Gaussians(
        means=row[:, None].repeat(1, 3),
        scales=torch.tensor(scales).log()[:, None].repeat(1, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacities=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh0=row[:, None, None].repeat(1, 1, 3) + 0.25,
        shN=row[:, None, None].repeat(1, 3, 3) + 0.5,
    )
    groups = [{"name": k, "params": [t.requires_grad_()], "lr": 1e-3} for k, t in gaussians.named().items()]
    optimizer = Adam(groups, lr=1e-3)
    for tensor in gaussians.named().values():
        tensor.grad = torch.ones_like(tensor)
    optimizer.step()
    for tensor in gaussians.named().values():
        ramp = torch.arange(1.0, n + 1).reshape(-1, *[1] * (tensor.ndim - 1))
        with torch.no_grad():
            for key in ("exp_avg", "exp_avg_sq"):
                optimizer.state[tensor][key].copy_(ramp.expand(tensor.shape))
    return gaussians, optimizer


def densifier(gaussians: Gaussians, config: DensifyConfig = CONFIG, seed: int = 0) -> Densifier:
    return Densifier(config, extent=1.0, reach=1.0, seed=seed, num_gaussians=len(gaussians))


def see(d: Densifier, gradients: list[float]) -> None:
    """One view in which every Gaussian is visible, with these gradient norms in half images."""
    grad = torch.zeros(len(gradients), 2)
    grad[:, 0] = torch.tensor(gradients) / (SIZE / 2)
    d.observe(grad, torch.ones(len(gradients), 2, dtype=torch.int32), SIZE, SIZE)


def moments(gaussians: Gaussians, optimizer: Adam, key: str = "exp_avg") -> list[float]:
    """The moment of each row, which must be the same number in every element of every tensor."""
    tables = []
    for name, tensor in gaussians.named().items():
        value = optimizer.state[tensor][key]
        assert value.shape == tensor.shape, name
        tables.append(value.reshape(len(gaussians), -1))
    rows = torch.cat(tables, dim=1)
    assert (rows == rows[:, :1]).all()
    return rows[:, 0].tolist()


def identity(gaussians: Gaussians) -> list[float]:
    """Which original row each row's colours come from."""
    return (gaussians.sh0[:, 0, 0] - 0.25).detach().round().tolist()


def test_clone_split_and_keep_with_the_state_row_by_row() -> None:
    g, optimizer = make([CLONED, SPLIT, KEPT, CLONED, SPLIT])
    before = {name: tensor.detach().clone() for name, tensor in g.named().items()}
    d = densifier(g)
    see(d, [1.5 * THRESHOLD, 1.5 * THRESHOLD, 0.0, 0.5 * THRESHOLD, 0.0])
    assert d.update(10, g, optimizer) == Densification(cloned=1, split=1)

    # Kept rows first, then the clone of row 0, then the two children that replace row 1.
    origin = [0, 2, 3, 4, 0, 1, 1]
    assert identity(g) == origin
    for key in ("exp_avg", "exp_avg_sq"):
        assert moments(g, optimizer, key) == [1, 3, 4, 5, 0, 0, 0]
    for name, tensor in g.named().items():
        whole = slice(0, 5) if name in ("means", "scales") else slice(0, 7)
        assert torch.equal(tensor.detach()[whole], before[name][torch.tensor(origin)][whole]), name
    children = g.scales.detach()[5:].exp()
    assert torch.allclose(children, before["scales"][1].exp() / 1.6)
    distance = (g.means.detach()[5:] - before["means"][1]).norm(dim=1)
    assert (distance > 0).all()
    assert (distance < 6 * SPLIT).all()


def test_the_optimizer_trains_the_new_tensors() -> None:
    g, optimizer = make([CLONED, SPLIT, KEPT])
    d = densifier(g)
    see(d, [1.0, 1.0, 0.0])
    d.update(10, g, optimizer)
    assert len(optimizer.state) == len(g.named())  # nothing is left of the old tensors
    assert [
        group["params"][0] is t for group, t in zip(optimizer.param_groups, g.named().values(), strict=True)
    ]
    before = {name: tensor.detach().clone() for name, tensor in g.named().items()}
    for tensor in g.named().values():
        assert tensor.is_leaf
        assert tensor.requires_grad
        tensor.grad = torch.ones_like(tensor)
    optimizer.step()
    for name, tensor in g.named().items():
        assert (tensor.detach() < before[name]).all(), name


def test_children_follow_the_distribution_of_their_parent() -> None:
    """The offsets' second moments are the covariance R S S R^T."""
    n = 20_000
    scales = torch.tensor([0.02, 0.05, 0.4])
    half = 0.5 * 0.7
    quat = torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])  # 0.7 rad about z
    g, optimizer = make([SPLIT] * n)
    with torch.no_grad():
        g.scales.copy_(scales.log())
        g.quats.copy_(3 * quat)  # of any norm
        g.means.zero_()
    d = densifier(g)
    see(d, [1.0] * n)
    d.update(10, g, optimizer)
    assert len(g) == 2 * n
    offsets = g.means.detach().double()
    rotation = torch.tensor(
        [[math.cos(0.7), -math.sin(0.7), 0], [math.sin(0.7), math.cos(0.7), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    expected = rotation @ torch.diag(scales.double() ** 2) @ rotation.T
    found = offsets.T @ offsets / len(offsets)
    assert torch.allclose(found, expected, rtol=0.05, atol=0.03 * 0.02 * 0.4)
    assert offsets.mean(dim=0).abs().max() < 5 * 0.4 / math.sqrt(2 * n)


def test_rotations_of_quaternions() -> None:
    quats = torch.tensor([[1.0, 0, 0, 0], [0, 2.0, 0, 0], [1.0, 0, 0, 1.0]])
    expected = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 0, 0], [0, -1, 0], [0, 0, -1]]]
    expected += [[[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
    assert torch.allclose(quats_to_matrices(quats), torch.tensor(expected, dtype=torch.float32), atol=1e-6)


@pytest.mark.parametrize(("width", "height"), [(100, 100), (400, 100), (64, 300)])
def test_the_threshold_is_in_half_images_per_axis(width: int, height: int) -> None:
    grad = torch.tensor(
        [
            [1.01 * THRESHOLD / (width / 2), 0.0],
            [0.99 * THRESHOLD / (width / 2), 0.0],
            [0.0, -1.01 * THRESHOLD / (height / 2)],
            [0.0, 0.99 * THRESHOLD / (height / 2)],
            [0.8 * THRESHOLD / (width / 2), 0.8 * THRESHOLD / (height / 2)],  # 1.13 in all
        ]
    )
    g, optimizer = make([CLONED] * 5)
    d = densifier(g)
    d.observe(grad, torch.ones(5, 2, dtype=torch.int32), width, height)
    assert d.update(10, g, optimizer).cloned == 3
    assert identity(g)[5:] == [0, 2, 4]


def test_views_that_do_not_see_a_gaussian_are_not_counted() -> None:
    g, optimizer = make([CLONED, CLONED])
    d = densifier(g)
    grad = torch.full((2, 2), 1.2 * THRESHOLD / (SIZE / 2) / math.sqrt(2))
    d.observe(grad, torch.tensor([[3, 2], [3, 2]], dtype=torch.int32), SIZE, SIZE)
    for _ in range(5):  # row 0 is not there, row 1 is there without a gradient
        d.observe(grad * torch.tensor([[7.0], [0.0]]), torch.tensor([[0, 0], [1, 1]]).int(), SIZE, SIZE)
    assert d.count.tolist() == [1, 6]
    assert d.update(10, g, optimizer).cloned == 1
    assert identity(g) == [0, 1, 0]
    assert d.count.tolist() == [0, 0, 0]
    assert d.grad_sum.tolist() == [0, 0, 0]


def test_transparent_gaussians_are_pruned_and_the_rest_stays_aligned() -> None:
    g, optimizer = make([KEPT] * 6)
    with torch.no_grad():
        g.opacities[torch.tensor([1, 4])] = math.log(0.0049 / 0.9951)
        g.opacities[2] = math.log(0.0051 / 0.9949)
    d = densifier(g)
    assert d.update(10, g, optimizer) == Densification(pruned=2)
    assert identity(g) == [0, 2, 3, 5]
    assert moments(g, optimizer) == [1, 3, 4, 6]


def test_large_gaussians_are_pruned_after_the_first_reset_only() -> None:
    g, optimizer = make([0.099, 0.101, 0.02])
    d = densifier(g)
    assert d.update(30, g, optimizer).pruned == 0
    assert d.update(40, g, optimizer).pruned == 1
    assert identity(g) == [0, 2]


def test_the_reach_says_what_is_too_large_and_the_extent_what_is_split() -> None:
    g, optimizer = make([0.101, 0.301])
    d = Densifier(CONFIG, extent=100.0, reach=3.0, seed=0, num_gaussians=len(g))
    see(d, [1.0, 1.0])
    growth = d.update(40, g, optimizer)  # 0.01 of the extent: both are cloned, not split
    assert (growth.cloned, growth.split, growth.pruned) == (2, 0, 2)
    assert identity(g) == [0, 0]


def test_children_are_judged_by_their_own_size() -> None:
    g, optimizer = make([0.15])  # children: 0.094
    d = densifier(g)
    see(d, [1.0])
    assert d.update(40, g, optimizer) == Densification(split=1)
    assert len(g) == 2


def test_reset_cuts_the_opacities_and_forgets_their_moments_alone() -> None:
    g, optimizer = make([KEPT] * 3)
    with torch.no_grad():
        g.opacities[1] = math.log(0.007 / 0.993)
    reset_opacities(g, optimizer, CONFIG.reset_opacity)
    np.testing.assert_allclose(g.activated_opacities().detach().numpy(), [0.01, 0.007, 0.01], rtol=1e-5)
    assert not optimizer.state[g.opacities]["exp_avg"].any()
    assert not optimizer.state[g.opacities]["exp_avg_sq"].any()
    assert optimizer.state[g.means]["exp_avg"][:, 0].tolist() == [1, 2, 3]


def test_the_cap_takes_the_highest_gradients_first() -> None:
    g, optimizer = make([CLONED, SPLIT, CLONED, SPLIT, CLONED])
    d = densifier(g, replace(CONFIG, max_gaussians=7))
    see(d, [3.0, 5.0, 4.0, 2.0, 1.0])
    assert d.update(10, g, optimizer) == Densification(cloned=1, split=1)
    assert identity(g) == [0, 2, 3, 4, 2, 1, 1]
    see(d, [1.0] * 7)
    assert d.update(20, g, optimizer) == Densification()
    assert len(g) == 7


def test_all_gaussians_can_go() -> None:
    g, optimizer = make([KEPT] * 3, opacity=0.001)
    assert densifier(g).update(10, g, optimizer).pruned == 3
    assert len(g) == 0


def test_schedules_of_other_lengths() -> None:
    lengths = {
        length: TrainConfig(iterations=length).due for length in (1, 400, 1_400, 7_000, 30_000, 50_000)
    }
    assert {length: (due.start, due.stop, due.every) for length, due in lengths.items()} == {
        1: (0, 0, 1),
        400: (28, 266, 20),
        1_400: (100, 933, 70),
        7_000: (500, 4_666, 100),
        30_000: (500, 15_000, 100),
        50_000: (500, 15_000, 100),
    }
    said = TrainConfig(iterations=1_400, eval_every=7, densify=DensifyConfig(every=9)).due
    assert (said.eval_every, said.every, said.start) == (7, 9, 100)


def test_the_same_seed_gives_the_same_children() -> None:
    def children(seed: int, iteration: int) -> Tensor:
        g, optimizer = make([SPLIT] * 4)
        d = densifier(g, seed=seed)
        see(d, [1.0] * 4)
        d.update(iteration, g, optimizer)
        return g.means.detach()

    torch.manual_seed(1)
    first = children(3, 10)
    torch.manual_seed(2)  # global state plays no part
    assert torch.equal(children(3, 10), first)
    assert not torch.equal(children(4, 10), first)
    assert not torch.equal(children(3, 20), first)


@pytest.mark.parametrize(
    ("field", "value"),
    [("every", 0), ("reset_every", -1), ("grad_threshold", math.nan), ("prune_opacity", 0.0), ("stop", -1)],
)
def test_bad_settings_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}"):
        DensifyConfig(**{field: value})  # type: ignore[arg-type]
