"""The benchmark `stability`: error of values and gradients on stiff cases, against 100 decimal digits."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import hqgs
from benchmarks.command import Benchmark
from benchmarks.pages.figures import records
from benchmarks.pages.sections import families
from benchmarks.rows import Table, facts
from benchmarks.stability.cases import Case, cases
from benchmarks.stability.oracle import GROUPS, KINDS, Array, Oracle, OracleScene, Pixel, load_mpmath

CAMERA = (
    "width",
    "height",
    "near_plane",
    "far_plane",
    "eps2d",
    "sh_degree",
)  # as `hqgs.rasterization` has it
VALUE_F64, GRADIENT_F64 = 1e-12, 1e-9  # relative
VALUE_F32, COSINE = 1e-5, 0.99999  # absolute, for ordinary cases; of each group of gradients
# A group of gradients below this share of the largest, each times the size of its parameter, is rounding.
NEGLIGIBLE = {"f32": 1e-4, "f64": 1e-6}
NUDGES = 4  # scenes with inputs one ulp off, whose largest change is the condition


@dataclass(frozen=True)
class Outcome:
    """What was measured of a case in one dtype. Errors are 0 where nothing is there to compare."""

    dtype: str
    as_expected: bool = True  # exactly the expected Gaussians are culled
    finite: bool = True  # image and gradients
    others_equal: bool = True  # without the culled Gaussians: the same bits; culled ones have gradient 0
    value_abs: float = 0.0
    value_relative: float = 0.0  # over the largest value of the oracle
    gradient: float = 0.0  # largest relative L2 of any group
    cosine: float = 1.0  # smallest of any group
    worst_group: str = ""


def render(s: OracleScene, dtype: str, cotangents: dict[Pixel, Array]) -> Any:
    """Image with alpha [H, W, D + 1], radii [N, 2] and gradients by group, as float64 arrays."""

    def tensor(values: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, KINDS[dtype]))

    leaves: dict[str, Any] = {name: tensor(getattr(s, name)).requires_grad_() for name in GROUPS}
    image, alphas, meta = hqgs.rasterization(
        **leaves,
        **{name: getattr(s, name) for name in CAMERA},
        viewmats=tensor(s.viewmat)[None],
        Ks=tensor(s.K)[None],
        backgrounds=None if s.background is None else tensor(s.background)[None],
        rasterize_mode="antialiased" if s.antialiased else "classic",
        packed=False,
    )
    full = torch.cat([image, alphas], dim=-1)[0]
    i, j = torch.tensor(list(cotangents)).T
    (full[i, j] * tensor(np.stack(list(cotangents.values())))).sum().backward()
    gradients = {name: leaf.grad.numpy().astype(np.float64) for name, leaf in leaves.items()}
    return full.detach().numpy().astype(np.float64), meta["radii"][0].numpy(), gradients


def weights(case: Case) -> dict[Pixel, Array]:
    """The cotangents of the compared pixels, exact in float32."""
    channels = (3 if case.scene.sh_degree is not None else case.scene.colors.shape[1]) + 1
    values = np.cos(1.0 + np.arange(len(case.pixels) * channels)).astype(np.float32).astype(np.float64)
    return dict(zip(case.pixels, values.reshape(-1, channels), strict=True))


def evaluate(case: Case, dtype: str) -> Outcome:
    """Measure one case."""
    s = case.scene.rounded(dtype)
    cotangents = weights(case)
    image, radii, gradients = render(s, dtype, cotangents)
    culled = case.expected_culled(dtype)
    seen = (radii > 0).all(axis=1)
    as_expected = set(np.flatnonzero(~seen)) == set(culled)
    finite = all(np.isfinite(a).all() for a in (image, *gradients.values()))
    equal = all((gradients[name][list(culled)] == 0).all() for name in GROUPS)
    if culled:
        image2, _, gradients2 = render(s.without(culled), dtype, cotangents)
        equal = equal and np.array_equal(image, image2)
        kept = [i for i in range(len(s.means)) if i not in culled]
        equal = equal and all(np.array_equal(gradients[name][kept], gradients2[name]) for name in GROUPS)
    if case.poison:
        return Outcome(dtype, as_expected, finite, equal)
    oracle = Oracle(s)
    checked = range(len(s.means)) if len(s.means) <= 10 else case.gradients_of or ()
    as_expected = as_expected and all((oracle.splat(i) is None) == (i in culled) for i in checked)
    wanted = [oracle.pixel(pixel) for pixel in case.pixels]
    errors = value_errors([image[pixel] for pixel in case.pixels], wanted)
    ids = case.compared
    worst, cosine, group = compare_gradients(
        s, dtype, {name: gradients[name][ids] for name in GROUPS}, oracle.gradients(cotangents, ids), ids
    )
    return Outcome(dtype, as_expected, finite, equal, *errors, worst, cosine, group)


def value_errors(got: Sequence[Any], wanted: Sequence[Any]) -> tuple[float, float]:
    """Largest absolute difference of two lists of pixels, and the same over the largest value wanted."""
    truth = np.array(wanted, object)
    error, size = (float(np.abs(values).max()) for values in (np.array(got, object) - truth, truth))
    return error, error / size if size else error


def condition(case: Case, dtype: str) -> Outcome:
    """What one ulp of the inputs changes in the oracle's own results: no algorithm can be asked for more."""
    s = case.scene.rounded(dtype)
    cotangents, ids, rng = weights(case), case.compared, np.random.default_rng(0)
    oracle = Oracle(s)
    values, gradients = [oracle.pixel(p) for p in case.pixels], oracle.gradients(cotangents, ids)
    found = []
    for _ in range(NUDGES):
        nudged = Oracle(s.nudged(dtype, rng))
        _, change = value_errors([nudged.pixel(p) for p in case.pixels], values)
        other = {name: np.array(rows, float) for name, rows in nudged.gradients(cotangents, ids).items()}
        found.append((change, *compare_gradients(s, dtype, other, gradients, ids)[:2]))
    changes, worst, cosines = zip(*found, strict=True)
    return Outcome(dtype, value_relative=max(changes), gradient=max(worst), cosine=min(cosines))


def compare_gradients(
    s: OracleScene, dtype: str, gradients: dict[str, Array], reference: dict[str, Any], ids: list[int]
) -> tuple[float, float, str]:
    """Largest relative L2 and smallest cosine over Gaussians `ids` and groups, and the group of the former.

    Each Gaussian and group is compared by itself, so that a large one hides no small one. A gradient whose
    product with its parameter is below NEGLIGIBLE of the largest such product is held against that share.
    """
    rows = []
    for k, i in enumerate(ids):
        for name in GROUPS:
            truth = np.array([float(v) for v in reference[name][k]])
            values = getattr(s, name)[i]
            if name == "means":
                values = s.viewmat[:3, :3] @ values + s.viewmat[:3, 3]
            parameter = float(np.linalg.norm(values))
            parameter = parameter if math.isfinite(parameter) else 0.0  # culled
            rows.append((name, truth, gradients[name][k].ravel()[: len(truth)], parameter))
    largest = max((np.linalg.norm(truth) * parameter for _, truth, _, parameter in rows), default=0.0)
    worst, cosine, group = 0.0, 1.0, ""
    for name, truth, found, parameter in rows:
        length = float(np.linalg.norm(truth))
        least = NEGLIGIBLE[dtype] * largest / parameter if parameter > 0 else 0.0
        if max(length, least) == 0.0:
            continue
        unit = max(length, least)
        error = float(np.linalg.norm((found - truth) / unit))
        if error > worst:
            worst, group = error, name
        if length >= least:
            f = found / unit
            with np.errstate(invalid="ignore"):
                cosine = min(cosine, float(f @ (truth / length) / max(np.linalg.norm(f), 1e-300)))
    return worst, cosine, group


def misses(case: Case, outcome: Outcome) -> list[str]:
    """The targets that a case misses, in words."""
    o, exact = outcome, outcome.dtype == "f64"
    values = o.value_relative if exact else o.value_abs
    limit = VALUE_F64 if exact else VALUE_F32 if case.ordinary else math.inf
    missed = {
        "not the expected Gaussians are culled": not o.as_expected,
        "not finite": not o.finite,
        "a culled Gaussian is noticed": not o.others_equal,
        f"values {values:.1e} > {limit:g}": values > limit,
        f"gradient of {o.worst_group} {o.gradient:.1e} > {GRADIENT_F64:g}": exact
        and o.gradient > GRADIENT_F64,
        f"cosine {o.cosine:.6f} < {COSINE}": o.cosine < COSINE,
    }
    return [words for words, is_so in missed.items() if is_so]


def line_of(case: Case, outcome: Outcome) -> dict[str, Any]:
    """The columns of its line: where targets are missed, with what an ulp of the inputs changes. Inputs that
    are not finite have no oracle."""
    missed = misses(case, outcome)
    line: dict[str, Any] = {"group": case.group, "case": case.name, "dtype": outcome.dtype}
    if not case.poison:
        line |= {"value_abs": outcome.value_abs, "value_relative": outcome.value_relative}
        line |= {"gradient": outcome.gradient, "turn": max(0.0, 1 - outcome.cosine)}
    line |= {"met": not missed, "by": "; ".join(missed)}
    if missed and not case.poison:
        limits = condition(case, outcome.dtype)
        line |= {"ulp_value": limits.value_relative, "ulp_gradient": limits.gradient}
    return line


def run(args: argparse.Namespace) -> list[str]:
    """Evaluate the catalogue."""
    load_mpmath()
    if args.quick and args.long:
        raise ValueError("--quick and --long exclude each other")
    table, lines = Table(args.out / "stability.csv"), []
    for case in cases(args.long):
        print(f"stability: {case.name}", file=sys.stderr)
        lines += [line_of(case, evaluate(case, dtype)) | facts() for dtype in KINDS]
    runs = table.frame(table.put(lines))
    lost = runs.loc[~runs["met"]]
    words = [f"{line['case']}, {line['dtype']}: {line['by']}" for line in records(lost)]
    return [families(runs), *words]


OPTIONS = {"--long": {"action": "store_true", "help": "also deep stacks and a large image"}}
BENCHMARK = Benchmark("errors on stiff and extreme cases, against 100 digits", run, options=OPTIONS)
