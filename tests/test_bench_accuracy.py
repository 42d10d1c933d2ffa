"""`accuracy` at tiny sizes, and the knobs behind it against the independent float64 renderer."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import reference
import torch
from pandas import DataFrame
from reference import reference_rasterization
from scenes import random_scene

import hqgs
from benchmarks import cli
from benchmarks.accuracy import CASES, ORACLES, Knobs, TunedPass, errors_against
from benchmarks.pages.sections import unbeaten_default
from benchmarks.rows import Table
from benchmarks.speed.inputs import make_inputs
from benchmarks.speed.rasterizer import RasterPass
from hqgs import _rust

DEFAULT = (1 / 255, 0.999e-4, "ellipse", True)


def call(*arguments: str | Path) -> int:
    return cli.main(["accuracy", *map(str, arguments)])


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> DataFrame:
    out = tmp_path_factory.mktemp("bench")
    hqgs.set_num_threads(2)
    # with some seeds, such as 5, float32 ends the list of one pixel another layer than float64
    assert call("--quick", "--out", out, "--seed", "7") == 0
    assert hqgs.get_num_threads() == 2
    return Table(out / "accuracy.csv").frame()


INPUTS = ["cloud of 500", "built-in scene, trained"]


def rows_of(runs: DataFrame, inputs: str) -> dict[tuple[str, str], dict[str, Any]]:
    lines = runs.loc[runs["inputs"] == inputs].to_dict("records")
    return {(line["knob"], line["value"]): {str(k): v for k, v in line.items()} for line in lines}


@pytest.mark.parametrize("inputs", INPUTS)
def test_errors_are_ordered_as_their_causes(quick: DataFrame, inputs: str) -> None:
    rows = rows_of(quick, inputs)
    assert list(rows) == list(CASES)
    default = rows["default", ""]
    for what in ("image", "gradients"):
        exact, defined = f"{what}_exact", f"{what}_defined"
        # against the definition: float64 is it, float32 rounds
        assert rows["dtype", "float64"][defined] == 0 < default[defined] < 1e-4
        # against the exact result: the looser, the larger
        floors = [rows["cutoffs", "none"], *(rows["alpha floor", f"1/{n}"] for n in (1024, 128, 64))]
        floors.insert(2, default)
        found = [row[exact] for row in floors]
        assert found == sorted(found)
        assert 0 < found[0] < 0.01 * found[1]
        assert found[-1] > 2 * found[2]
        assert rows["cutoffs", "none, float64"][exact] == 0
    stops = [rows["transmittance stop", stop]["image_exact"] for stop in ("1e-5", "1e-3", "1e-2")]
    assert stops[0] <= default["image_exact"] * (1 + 1e-4)
    assert stops[0] < stops[2]


@pytest.mark.parametrize("inputs", INPUTS)
def test_what_only_does_more_work_has_the_same_error(quick: DataFrame, inputs: str) -> None:
    rows = rows_of(quick, inputs)
    default, boxes = rows["default", ""], rows["tiles", "bounding box"]
    unskipped = rows["block skipping", "off"]
    for name in ("image_exact", "image_defined", "gradients_exact", "gradients_defined"):
        assert default[name] == boxes[name] == unskipped[name]
    assert default["tile_pairs"] <= boxes["tile_pairs"]
    assert default["tile_pairs"] == unskipped["tile_pairs"]
    assert default["blocks_ratio"] == 1 < unskipped["blocks_ratio"]


def test_every_row_has_a_time_and_finite_errors(quick: DataFrame) -> None:
    for inputs in INPUTS:
        rows = rows_of(quick, inputs)
        assert rows["default", ""]["ratio"] == 1
        for row in rows.values():
            assert row["seconds"] > 0
            assert 0 < row["ratio_low"] <= row["ratio"] <= row["ratio_high"]
            for oracle in ("exact", "defined"):
                assert 0 <= row[f"image_{oracle}"] <= row[f"image_{oracle}_max"]
                assert 0 <= row[f"gradients_{oracle}"] < 10


@pytest.mark.parametrize(("floor", "stop"), [(1 / 64, 1e-2), (1 / 1024, 1e-5), (1e-12, 0.0)])
def test_floor_and_stop_follow_the_definition(
    floor: float, stop: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The crate with other cutoffs against a renderer that shares nothing with it."""
    scene = random_scene(80, 32, 24, seed=4, sh_degree=1)
    _, _, meta = reference_rasterization(**scene.arguments())
    shown = (meta["radii"][0] > 0).all(dim=1)  # the reference culls by the radii of the default floor
    scene = scene.pick(shown.nonzero()[:, 0]).with_grad("means", "scales", "opacities", "colors")
    monkeypatch.setattr(reference, "ALPHA_FLOOR", floor)
    monkeypatch.setattr(reference, "TRANSMITTANCE_STOP", stop)
    leaves = (scene.means, scene.scales, scene.opacities, scene.colors)
    expected, _, _ = reference_rasterization(**scene.arguments())
    weights = torch.rand(expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    wanted = torch.autograd.grad((expected * weights).sum(), leaves)
    project = _rust.project_forward
    tuned = (floor, stop, *DEFAULT[2:])
    monkeypatch.setattr(_rust, "project_forward", lambda *args: project(*args, knobs=tuned))
    image, _, _ = hqgs.rasterization(**scene.arguments())
    grads = torch.autograd.grad((image * weights).sum(), leaves)
    assert (image - expected).abs().max() < 1e-10
    for found, grad in zip(grads, wanted, strict=True):
        assert (found - grad).norm() < 1e-8 * grad.norm()


def test_the_exact_oracle_has_no_cutoffs_left() -> None:
    inputs = make_inputs(300, 48, 36, seed=2)
    exact = TunedPass(inputs, ORACLES["exact"]).outputs()
    further = Knobs(dtype="float64", alpha_min=1e-15, transmittance_min=0.0)
    errors = errors_against(TunedPass(inputs, further).outputs(), exact)
    assert 0 < errors["max"] < 1e-10
    assert errors["gradients"] < 1e-9


def test_default_knobs_are_the_default() -> None:
    inputs = make_inputs(300, 48, 36, seed=2)
    plain, default = RasterPass(inputs), TunedPass(inputs, Knobs())
    assert next(iter(CASES.items())) == (("default", ""), Knobs())
    assert ORACLES["defined"] == Knobs(dtype="float64")
    assert tuple(asdict(default.knobs).values())[1:] == DEFAULT
    assert torch.equal(plain.run(), default.run())
    for a, b in zip(plain.leaves, default.leaves, strict=True):
        assert a.grad is not None
        assert b.grad is not None
        assert torch.equal(a.grad, b.grad)


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        (Knobs(alpha_min=0.0), r"alpha_min: must be in \[1e-15, 1\), got 0"),
        (Knobs(alpha_min=math.nan), "alpha_min"),
        (Knobs(transmittance_min=1.0), r"transmittance_min: must be in \[0, 1\), got 1"),
        (Knobs(spans="disc"), "spans: must be ellipse or box, got disc"),
    ],
)
def test_bad_knobs_are_refused_by_name(knobs: Knobs, message: str) -> None:
    case = TunedPass(make_inputs(20, 30, 20), knobs)
    with pytest.raises(ValueError, match=message):
        case.run()


def test_the_public_function_has_no_knobs() -> None:
    scene = random_scene(5, 8, 8)
    with pytest.raises(TypeError, match="knobs"):
        hqgs.rasterization(**scene.arguments(), knobs=DEFAULT)


def test_errors_of_a_hand_made_case() -> None:
    exact = {"image": torch.zeros(1, 2, 1, 1), "a": torch.tensor([3.0, 0.0]), "b": torch.tensor([[4.0]])}
    found = {"image": torch.tensor([0.3, -0.4]).view(1, 2, 1, 1), "a": torch.tensor([0.0, 3.0])}
    errors = errors_against(found | {"b": torch.tensor([[4.0]])}, exact)
    assert errors["max"] == pytest.approx(0.4)
    assert errors["rms"] == pytest.approx(math.sqrt(0.125))
    assert errors["gradients"] == pytest.approx(math.sqrt(18) / 5)


def test_the_default_is_beaten_only_by_what_is_clearly_faster_and_nowhere_worse() -> None:
    def words(error: float, slowest: float, defined: float = 1.0) -> str:
        names = ("image_exact", "gradients_exact", "image_defined", "gradients_defined")
        same = {"inputs": "cloud", "knob": "default", "value": "", "ratio_high": 1.0}
        default = same | dict.fromkeys(names, 1.0)
        other = same | {"knob": "tiles", "value": "box", "ratio_high": slowest}
        other |= dict.fromkeys(names[:2], error) | dict.fromkeys(names[2:], defined)
        return unbeaten_default(DataFrame([default, other]))

    assert words(1.0, 0.9) == "Better than the default in error and in time: tiles box (cloud)."
    no = "No setting is better than the default in error and in time."
    assert words(1.0, 1.1) == no  # within the noise
    assert words(1.1, 0.9) == no
    assert words(0.9, 0.9, defined=1.1) == no
