"""The benchmark `stability`: error of values and gradients on stiff cases, against 100 decimal digits."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.charts import BLUE, ORANGE, panels
from benchmarks.data import read_toml
from benchmarks.output import Benchmark, Report, table
from benchmarks.stability import measure
from benchmarks.stability.cases import Case, cases
from benchmarks.stability.measure import VALUE_F32, Outcome, misses
from benchmarks.stability.oracle import DIGITS, load_mpmath

COLUMNS = Path(__file__).with_name("columns.toml")
Rows = list[tuple[Case, list[Outcome]]]  # in float32 and in float64


def run(args: argparse.Namespace) -> Report:
    """Evaluate the catalogue."""
    load_mpmath()
    if args.quick and args.long:
        raise ValueError("--quick and --long exclude each other")
    targets = {
        "f64_values": measure.VALUE_F64, "f64_gradients": measure.GRADIENT_F64, "f32_ordinary": VALUE_F32,
        "cosine": measure.COSINE, "negligible": measure.NEGLIGIBLE,
    }  # fmt: skip
    report = Report(settings={"long": args.long, "digits": DIGITS} | targets)
    rows: Rows = []
    for case in cases(args.long):
        print(f"stability: {case.name}", file=sys.stderr)
        rows.append((case, [measure.evaluate(case, dtype) for dtype in ("f32", "f64")]))
    missed = [(case, outcome) for case, outcomes in rows for outcome in outcomes if misses(case, outcome)]
    conditions = {(case.name, o.dtype): measure.condition(case, o.dtype) for case, o in missed}
    rounding = measure.input_rounding(next(case for case, _ in rows if case.name == "world offset 1e6"))
    report.results = {
        "cases": [
            {
                "name": case.name,
                "reason": case.why,
                "culled": {o.dtype: list(case.expected_culled(o.dtype)) for o in outcomes},
                "outcomes": [{**vars(o), "misses": misses(case, o)} for o in outcomes],
            }
            for case, outcomes in rows
        ],
        "conditions": [{"name": name, **vars(found)} for (name, _), found in conditions.items()],
        "world_offset_f32_input_rounding": rounding,
    }
    report.tables = tables(rows, conditions, rounding)
    report.figures["errors"] = chart(rows)
    return report


def tables(rows: Rows, conditions: dict[tuple[str, str], Outcome], rounding: float) -> list[str]:
    lines, missed = [], []
    for case, outcomes in rows:
        words: dict[str, Any] = {"name": case.name, "why": case.why, "targets": "met"}
        for o in outcomes:
            if found := misses(case, o):
                words["targets"] = "missed"
                missed.append(vars(conditions[case.name, o.dtype]) | words | {"by": "; ".join(found)})
            words[o.dtype] = vars(o)
        if not case.poison:
            in_f32, in_f64 = (len(case.expected_culled(o.dtype)) for o in outcomes)
            culled = f"{in_f32 or ''}" if in_f32 == in_f64 else f"f32 {in_f32}, f64 {in_f64}"
            lines.append(words | {"culled": culled, "turn": max(0.0, 1 - outcomes[0].cosine)})
    poison = [misses(case, o) for case, outcomes in rows if case.poison for o in outcomes]
    good, columns = f"{poison.count([])} of {len(poison)}", read_toml(COLUMNS)
    return [
        table("Error against the oracle, on the same rounded inputs", lines, columns["errors"]),
        table("Targets that are missed, and what one ulp of the inputs changes", missed, columns["missed"]),
        f"Inputs that are not finite: {good} culled, with every other bit unchanged.",
        f"World offset 1e6: rounding the inputs to float32 alone changes a value by up to {rounding:.1e}.",
    ]


def chart(rows: Rows) -> Figure:
    """Two panels, values and gradients: one row per case, f32 and f64, the targets as lines."""
    shown = [(case, outcomes) for case, outcomes in rows if not case.poison]
    figure, (left, right) = panels(10, 2 + 0.16 * len(shown), 1, 2, sharey=True)
    y = np.arange(len(shown))
    for axes, field, limit, what in (
        (left, "value_relative", measure.VALUE_F64, "values, relative"),
        (right, "gradient", measure.GRADIENT_F64, "gradients, relative L2"),
    ):
        for k, (dtype, color) in enumerate((("f32", ORANGE), ("f64", BLUE))):
            errors = [max(getattr(outcomes[k], field), 1e-18) for _, outcomes in shown]
            axes.plot(errors, y, "o", color=color, markersize=4, label=dtype)
        axes.axvline(limit, color=BLUE, linestyle="--", linewidth=1, label=f"target f64, {limit:g}")
        axes.set(xscale="log", xlabel=what)
        axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.01), ncols=3, frameon=False)
    left.axvline(VALUE_F32, color=ORANGE, linestyle="--", linewidth=1)  # absolute, but the values are near 1
    left.set_yticks(y, [case.name for case, _ in shown], fontsize=7)
    left.set_ylim(len(shown), -1)
    return figure


OPTIONS = {"--long": {"action": "store_true", "help": "also deep stacks and a large image"}}
BENCHMARK = Benchmark("errors on stiff and extreme cases, against 100 digits", run, options=OPTIONS)
