"""Stiff and extreme scenes against 100 decimal digits, and that oracle against numbers known otherwise."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference import reference_rasterization

from benchmarks import cli
from benchmarks.rows import Table
from benchmarks.stability import run
from benchmarks.stability.cases import PIXELS, cases, scene
from benchmarks.stability.oracle import GROUPS, Oracle
from benchmarks.stability.run import (
    COSINE,
    GRADIENT_F64,
    VALUE_F64,
    condition,
    evaluate,
    misses,
    value_errors,
)
from hqgs.base.elementary import exp, log

CASES = {case.name: case for case in cases()}


ILL = [name for name, case in CASES.items() if case.ill_conditioned]
DTYPES = ("f32", "f64")


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", [name for name in CASES if name not in ILL])
def test_targets(name: str, dtype: str) -> None:
    outcome = evaluate(CASES[name], dtype)
    assert misses(CASES[name], outcome) == [], outcome


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ILL)
def test_ill_conditioned_cases_err_by_less_than_one_ulp_of_the_inputs_changes(name: str, dtype: str) -> None:
    """The oracle itself moves by more; and it does miss the targets, or the case need not be marked."""
    outcome, limit = evaluate(CASES[name], dtype), condition(CASES[name], dtype)
    assert outcome.finite
    assert outcome.as_expected
    assert outcome.others_equal
    assert misses(CASES[name], outcome)
    assert outcome.gradient <= limit.gradient
    assert limit.gradient > GRADIENT_F64
    if dtype == "f64":
        assert outcome.value_relative < VALUE_F64
        assert outcome.cosine > COSINE
    else:
        assert outcome.value_relative <= limit.value_relative


def test_condition_of_an_ordinary_scene_is_a_few_ulp() -> None:
    for dtype, ulp in (("f32", 2.0**-23), ("f64", 2.0**-52)):
        found = condition(CASES["ordinary"], dtype)
        assert 0.1 * ulp < found.value_relative < 10 * ulp
        assert ulp < found.gradient < 1000 * ulp
        assert found.cosine > COSINE


def test_oracle_on_a_case_done_by_hand() -> None:
    """A round Gaussian on the axis: cov2d = (f s / z)^2 + 0.3, and alpha is a plain Gaussian of the pixel."""
    s = scene(
        means=np.array([[0.0, 0.0, 4.0]]),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]]),
        scales=np.full((1, 3), 0.5),
        opacities=np.array([0.5]),
        colors=np.array([[0.25]]),
        background=np.array([1.0]),
    )
    alpha = 0.5 * math.exp(-0.5 * (1.5**2 + 1.0**2) / (2.5**2 + 0.3))
    color, opaque = Oracle(s).pixel((5, 7))  # centre (7.5, 5.5), Gaussian at (6, 4.5)
    assert float(opaque) == pytest.approx(alpha, rel=1e-15)
    assert float(color) == pytest.approx(0.25 * alpha + (1 - alpha), rel=1e-15)
    gradients = Oracle(s).gradients({(5, 7): np.array([1.0, 0.0])}, [0])
    assert float(gradients["opacities"][0][0]) == pytest.approx((0.25 - 1) * alpha / 0.5, rel=1e-15)
    assert float(gradients["colors"][0][0]) == pytest.approx(alpha, rel=1e-15)
    # d alpha / d x through the centre: x moves it by f / z; the covariance changes in second order only
    slope = alpha * 1.5 / (2.5**2 + 0.3) * 20 / 4
    assert float(gradients["means"][0][0]) == pytest.approx((0.25 - 1) * slope, rel=1e-14)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [None, 3])
def test_oracle_agrees_with_autograd(antialiased: bool, degree: int | None) -> None:
    """Two independent derivations: scalars in mpmath with differences, tensors in torch with autograd."""
    s = CASES["turned camera"].scene if degree is None else CASES["SH degree 3"].scene
    s = replace(s, antialiased=antialiased)
    leaves: dict[str, Any] = {name: torch.tensor(getattr(s, name), requires_grad=True) for name in GROUPS}
    assert s.background is not None
    image, alphas, _ = reference_rasterization(
        **leaves,
        viewmats=torch.tensor(s.viewmat)[None],
        Ks=torch.tensor(s.K)[None],
        width=s.width,
        height=s.height,
        sh_degree=degree,
        backgrounds=torch.tensor(s.background)[None],
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    full = torch.cat([image, alphas], dim=-1)[0]
    weights = np.random.default_rng(4).standard_normal((len(PIXELS), 4))
    oracle = Oracle(s)
    for pixel in PIXELS:
        wanted = [float(v) for v in oracle.pixel(pixel)]
        np.testing.assert_allclose(full[pixel].detach().numpy(), wanted, rtol=VALUE_F64)
    i, j = torch.tensor(PIXELS).T
    (full[i, j] * torch.tensor(weights)).sum().backward()
    gradients = oracle.gradients(dict(zip(PIXELS, weights, strict=True)), [0, 1])
    for name in GROUPS:
        got = leaves[name].grad
        assert got is not None
        wanted = np.array([[float(v) for v in row] for row in gradients[name]])
        error = np.linalg.norm(got.reshape(2, -1).numpy() - wanted) / np.linalg.norm(wanted)
        assert error < GRADIENT_F64, name


def test_a_wrong_picture_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The measure itself: a change of 1e-6 in one value, or of 1 % in one gradient, misses the targets."""
    right = run.render

    def wrong_image(*args):
        image, radii, gradients = right(*args)
        image[4, 5, 0] += 1e-6
        return image, radii, gradients

    def wrong_gradient(*args):
        image, radii, gradients = right(*args)
        gradients["quats"][1, 2] *= 1.01
        return image, radii, gradients

    case = CASES["ordinary"]
    for wrong, word in ((wrong_image, "values"), (wrong_gradient, "gradient of quats")):
        monkeypatch.setattr(run, "render", wrong)
        assert any(word in miss for miss in misses(case, evaluate(case, "f64")))


def test_rounding_of_geo_referenced_inputs_is_what_spoils_them() -> None:
    """float32 holds 2e6 to 0.125 units: the inputs are another scene, which is rendered right."""
    case = CASES["world offset 1e6"]
    exact, rounded = Oracle(case.scene), Oracle(case.scene.rounded("f32"))
    assert value_errors(*([oracle.pixel(p) for p in case.pixels] for oracle in (exact, rounded)))[0] > 1e-3
    assert evaluate(case, "f32").value_abs < 1e-5


def test_command_writes_a_line_for_each_case_and_dtype(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("ordinary", "behind the camera", "NaN in means[0]", "no low-pass, anisotropy 1e6")
    monkeypatch.setattr(run, "cases", lambda long: [CASES[name] for name in names])
    assert cli.main(["stability", "--quick", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "| shapes | 2 |" in printed
    assert "| not finite | 1 | – | – | – | – | met |" in printed
    assert "no low-pass, anisotropy 1e6, f64: gradient of" in printed
    found = Table(tmp_path / "stability.csv").frame()
    assert list(found["case"]) == [name for name in names for _ in range(2)]
    assert list(found["met"]) == 6 * [True] + 2 * [False]
    assert found["value_relative"][1] < VALUE_F64
    assert (found["ulp_gradient"].dropna() > found["gradient"][6:]).all()
    assert cli.main(["stability", "--quick", "--long", "--out", str(tmp_path)]) == 2


def test_a_mistake_in_the_catalogue_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.stability import cases as module

    monkeypatch.setattr(module, "FILE", tmp_path / "cases.toml")
    for text, message in (
        (
            'a = [{ name = "b", why = "c", firts = { means = [0.0, 0.0, 1.0] } }]',
            "'b': unknown field 'firts'",
        ),
        ('a = [{ name = "b" }]', "'b': .* missing 1 required .*: 'why'"),
        ('a = [{ name = "b", why = "c", culled = [0.5] }]', r"'b': culled\[0\] is 0.5, wanted int"),
        ("a = [", "cases.toml: "),
    ):
        (tmp_path / "cases.toml").write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=message):
            cases()


# --- exp and log against the standard library's, and their gradients


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
