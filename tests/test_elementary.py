"""exp and log against the standard library's, and their gradients."""

from __future__ import annotations

import math

import pytest
import torch

from hqgs.base.elementary import exp, log


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 4e-7), (torch.float64, 1e-15)])
def test_values_and_gradients_are_right(dtype: torch.dtype, error: float) -> None:
    x = torch.linspace(-20, 20, 1001, dtype=dtype).requires_grad_()
    found = exp(x)
    wanted = torch.tensor([math.exp(value) for value in x.tolist()], dtype=torch.float64)
    assert (found.detach().double() / wanted - 1).abs().max() < error
    back = log(found)
    assert (back.detach() - x.detach()).abs().max() < 20 * error
    (v_x,) = torch.autograd.grad(back.sum(), x)
    assert (v_x - 1).abs().max() < 2 * error


def test_a_number_and_what_has_no_logarithm() -> None:
    assert float(exp(torch.tensor(0.0))) == 1
    assert float(exp(torch.tensor(1e3))) == math.inf
    assert float(log(torch.tensor(0.0))) == -math.inf
    assert math.isnan(float(log(torch.tensor(-1.0))))
