"""Adam against torch's own, over many steps, with its state."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hqgs._rust import set_num_threads
from hqgs.training.adam import Adam

SHAPES = [(257, 3), (257,), (257, 15, 3), (257, 0, 3), ()]


def tensors(dtype: torch.dtype, seed: int = 0) -> list[Tensor]:
    rng = np.random.default_rng(seed)
    return [torch.tensor(rng.normal(size=shape), dtype=dtype).requires_grad_() for shape in SHAPES]


def set_grads(params: list[Tensor], step: int) -> None:
    """Gradients that range over six decades, some of them 0."""
    rng = np.random.default_rng([1, step])
    for param in params:
        grad = rng.normal(size=param.shape) * 10.0 ** rng.uniform(-6, 0, param.shape)
        param.grad = torch.tensor(np.where(rng.random(param.shape) < 0.1, 0.0, grad), dtype=param.dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-6), (torch.float64, 1e-14)])
@pytest.mark.parametrize("options", [{}, {"betas": (0.8, 0.95), "eps": 1e-15}])
def test_50_steps_agree_with_torch(dtype: torch.dtype, tolerance: float, options: dict[str, Any]) -> None:
    ours, theirs = tensors(dtype), tensors(dtype)
    groups = [[{"params": p[:2], "lr": 1e-2}, {"params": p[2:]}] for p in (ours, theirs)]
    optimizers = [Adam(groups[0], **options), torch.optim.Adam(groups[1], foreach=False, **options)]
    for step in range(50):
        for params, optimizer in zip((ours, theirs), optimizers, strict=True):
            set_grads(params, step)
            optimizer.param_groups[1]["lr"] = 1e-3 * 0.9**step
            optimizer.step()
    # torch may fuse a product with a sum, so the last bit of a moment can differ where it cancels.
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance / 10)
        state, expected = optimizers[0].state[a], optimizers[1].state[b]
        assert sorted(state) == sorted(expected) == ["exp_avg", "exp_avg_sq", "step"]
        for key, atol in (("exp_avg", tolerance / 30), ("exp_avg_sq", 0.0), ("step", 0.0)):
            torch.testing.assert_close(state[key], expected[key], rtol=tolerance, atol=atol)


@pytest.mark.parametrize("used", [0, 3, 8, 15])
def test_of_rows_that_are_used_in_part_the_first_are_updated(used: int) -> None:
    """Harmonics [N, K, 3] of a degree that training has not reached."""
    (whole, part), start = (tensors(torch.float32)[2:3] for _ in range(2)), tensors(torch.float32)[2]
    for params, given in ((whole, {}), (part, {"used": used})):
        set_grads(params, 1)
        Adam([{"params": params, **given}], lr=0.1).step()
    assert torch.equal(part[0][:, :used], whole[0][:, :used])
    assert torch.equal(part[0][:, used:], start[:, used:])


def test_parameters_without_a_gradient_are_left_alone() -> None:
    a, b = tensors(torch.float32)[:2]
    before = b.detach().clone()
    a.grad = torch.ones_like(a)
    optimizer = Adam([a, b])
    optimizer.step()
    assert torch.equal(b, before)
    assert b not in optimizer.state


def test_state_dict_round_trip_and_torchs_own() -> None:
    straight, resumed, torchs = (tensors(torch.float32) for _ in range(3))
    first, second = Adam(straight), torch.optim.Adam(torchs)
    for step in range(5):
        set_grads(straight, step)
        first.step()
    with torch.no_grad():
        for a, b, c in zip(straight, resumed, torchs, strict=True):
            b.copy_(a)
            c.copy_(a)
    optimizer = Adam(resumed)
    optimizer.load_state_dict(deepcopy(first.state_dict()))
    for step in range(5, 8):
        set_grads(straight, step)
        set_grads(resumed, step)
        first.step()
        optimizer.step()
    assert all(torch.equal(a, b) for a, b in zip(straight, resumed, strict=True))

    set_grads(torchs, 0)
    second.step()
    after = Adam(torchs)
    after.load_state_dict(second.state_dict())
    set_grads(torchs, 1)
    after.step()
    assert after.state[torchs[0]]["step"] == 2


def test_autograd_sees_that_the_parameter_changed() -> None:
    param = torch.ones(3, requires_grad=True)
    loss = (param * param).sum()
    param.grad = torch.ones(3)
    Adam([param]).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_closure_and_nan() -> None:
    param = torch.ones(2, requires_grad=True)
    optimizer = Adam([param])

    def closure() -> Tensor:
        loss = (param * torch.tensor([math.nan, 1.0])).sum()
        optimizer.zero_grad()
        loss.backward()
        return loss

    value = optimizer.step(closure)
    assert value is not None
    assert value.isnan()
    assert param.isnan().tolist() == [True, False]


def test_same_bits_for_any_number_of_threads() -> None:
    results = []
    for threads in (1, 2, 3):
        set_num_threads(threads)
        param = torch.linspace(-1, 1, 50_001).requires_grad_()
        optimizer = Adam([param], lr=0.01)
        for scale in (1.0, -0.3):
            param.grad = scale * param.detach() ** 2
            optimizer.step()
        results.append(param.detach())
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_bad_input_is_named() -> None:
    def step(param: Tensor, **options: Any) -> None:
        param.requires_grad_()
        param.grad = torch.ones_like(param)
        Adam([param], **options).step()

    ones = torch.ones(4, 3)
    for name, call in {
        "lr": lambda: step(ones.clone(), lr=-1.0),
        "beta1": lambda: step(ones.clone(), betas=(1.0, 0.9)),
        "beta2": lambda: step(ones.clone(), betas=(0.9, math.nan)),
        "eps": lambda: step(ones.clone(), eps=-1e-8),
        "param: must be a contiguous": lambda: step(torch.ones(3, 4).t()),
        "param: expected an array of float32 or float64, got float16": lambda: step(ones.half()),
        "weight_decay": lambda: Adam([{"params": [ones.clone()], "weight_decay": 0.1}]).step(),
    }.items():
        with pytest.raises(ValueError, match=name):
            call()
