"""The benchmark `parts`: each part can be left out, what is off is told, and lines are counted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from pandas import DataFrame

import hqgs
from benchmarks.parts import ALL, PARTS, alone, gains_of, length, lines_of, parts_table
from benchmarks.without import VARIABLE, function_at, without
from hqgs.base.text import some

PLACE = "hqgs.base.text:some"


@pytest.mark.parametrize("label", PARTS)
def test_what_a_part_names_is_there(label: str) -> None:
    part = PARTS[label]
    assert part.what
    assert lines_of(part) >= 5 * len(part.modules)
    with without(part.without):
        assert part.train_config(0, 100).method == "auto"
    for place in part.without:
        assert function_at(place).__code__.co_name != "neutral"  # it is back
    assert label == ALL or part.without or part != PARTS[ALL]


def test_whoever_imported_a_function_calls_the_other_one() -> None:
    before = some(["a", "b"])
    with without({PLACE: "(was(*args), len(args[0]))"}):
        assert some(["a", "b"]) == (before, 2)
        said = subprocess.run(
            [sys.executable, "-c", "from hqgs.base.text import some; print(some('abc')[1])"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert said.stdout == "3\n"
    assert some(["a", "b"]) == before
    assert VARIABLE not in os.environ
    with (
        pytest.raises(ValueError, match=r"there is no hqgs\.base\.text:gone"),
        without({"hqgs.base.text:gone": "0"}),
    ):
        pass


def test_lines_are_those_of_a_part_alone() -> None:
    """`weighted` is imported by `sharpen` alone; what others import, too, stays."""
    assert alone(["hqgs.scene.sfm.refine"]) > {"hqgs.scene.sfm.refine.weighted"}
    assert "hqgs.base.text" not in alone(["hqgs.cli.plan"])
    file = Path(hqgs.__file__).parent / "base" / "text.py"
    assert length("hqgs.base.text") == len(file.read_text(encoding="utf-8").splitlines())


def test_a_part_gains_only_where_it_is_on() -> None:
    rows = [
        ("a", ALL, 20.0, True),
        ("a", "discs", 19.0, True),
        ("b", ALL, 30.0, True),
        ("b", "discs", 30.0, False),
    ]
    runs = DataFrame(rows, columns=["scene", "row", "psnr", "on"]).assign(
        degradation="none",
        seed=0,
        iterations=1,
        downscale=1,
        poses="own",
        ssim=0.5,
        cpu_seconds=2.0,
        placed=3,
        lines=7,
        what="flat",
    )
    assert (gains_of(runs, "discs").mean, gains_of(runs, "discs").count) == (1.0, 1)
    assert "| discs: flat | 7 | 1 of 2 | +1.00 | +0.000 | +0 |" in parts_table(runs)
