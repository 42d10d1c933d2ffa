"""The tables, the verdicts and the chart of the benchmark `features`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame

from benchmarks.charts import LEGEND, color, panels, title
from benchmarks.data import read_toml
from benchmarks.features.switches import DEFAULT, Feature
from benchmarks.output import number, span, table
from benchmarks.speed.timing import quartiles

LIMIT_DB = 0.05  # what a feature that is on by default may cost, in the mean over the scenes
SURE = 2.0  # standard errors by which whole runs must be over the limit before they fail a feature
ON = {True: "on", False: "off"}
COLUMNS = read_toml(Path(__file__).with_name("features.toml"))["columns"]


def compare(
    features: Sequence[Feature], runs: dict[str, list[dict[str, Any]]], steps: dict[str, DataFrame]
) -> list[dict[str, Any]]:
    """One row for each feature, from runs that hold `psnr`, `refined_psnr` and `seconds`.

    `costs_db`: what the fast choice costs in held-out PSNR, run by run with the same seed, and
    `refined_costs_db` the same of the Gaussians that were grown once and trained on, empty where they cannot
    tell; `cost_db` and `refined_cost_db` their means. `speedup`: of the fast choice, over the other one.
    """
    rows = []
    for feature in features:
        other, sign = runs[feature.label], 1 if feature.by_default else -1
        pairs = list(zip(runs[DEFAULT.label], other, strict=True))
        costs, refined = (
            [sign * (b[name] - a[name]) for a, b in pairs if b[name] is not None]
            for name in ("psnr", "refined_psnr")
        )
        rounds = (steps[feature.label]["total"] / steps[DEFAULT.label]["total"]) ** sign
        rows.append(
            _about(feature)
            | {
                "psnr": float(np.mean([r["psnr"] for r in other])),
                "costs_db": costs,
                "cost_db": float(np.mean(costs)),
                "refined_costs_db": refined,
                "refined_cost_db": float(np.mean(refined)) if refined else None,
                "speedup_run": float(np.mean([(b["seconds"] / a["seconds"]) ** sign for a, b in pairs])),
                "speedup_step": rounds.median(),
                "speedup_step_quartiles": quartiles(rounds),
                "runs": other,
            }
        )
    return rows


def _about(feature: Feature) -> dict[str, Any]:
    return {"feature": feature.label, "other": feature.other, "by_default": feature.by_default}


def verdicts(features: Sequence[Feature], scenes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean costs over the scenes, and whether the feature may be on.

    Growth decides by thresholds, so that a change of one bit makes other Gaussians: whole runs scatter by
    more than the limit. They fail a feature only where they are sure to be over it; the Gaussians that were
    grown once and trained on with either choice scatter little, and are held against the limit itself.
    """
    found = []
    for k, feature in enumerate(features):
        entry = _about(feature) | {"limit_db": LIMIT_DB}
        for kind in ("", "refined_"):
            costs = [cost for scene in scenes for cost in scene["features"][k][f"{kind}costs_db"]]
            error = np.std(costs, ddof=1) / np.sqrt(len(costs)) if costs[1:] else None
            entry[f"{kind}cost_db"] = float(np.mean(costs)) if costs else None
            entry[f"{kind}standard_error_db"] = None if error is None else float(error)
        sure = entry["cost_db"] - SURE * (entry["standard_error_db"] or 0.0)
        worst = max(sure, -np.inf if entry["refined_cost_db"] is None else entry["refined_cost_db"])
        found.append(entry | {"passed": not feature.by_default or bool(worst <= LIMIT_DB)})
    return found


def scene_table(scene: dict[str, Any]) -> str:
    default = scene["default"]
    psnr, seconds = (float(np.mean([r[name] for r in default])) for name in ("psnr", "seconds"))
    title = (
        f"{scene['scene']}, {scene['width']} x {scene['height']}, {scene['iterations']:,} iterations: "
        f"default {psnr:.2f} dB, {seconds:.0f} s, {default[0]['gaussians']:,} Gaussians"
    )
    lines = [
        row | {"on": ON[row["by_default"]], "quartiles": span(row["speedup_step_quartiles"], ".2f")}
        for row in scene["features"]
    ]
    return table(title, lines, COLUMNS["of_scene"])


def verdict_table(rows: Sequence[dict[str, Any]]) -> str:
    def with_error(row: dict[str, Any], kind: str) -> str:
        error = row[f"{kind}standard_error_db"]
        return number(row[f"{kind}cost_db"], "+.3f") + ("" if error is None else f" ± {error:.3f}")

    lines = [
        row
        | {"cost": with_error(row, ""), "refined": with_error(row, "refined_")}
        | {"on": ON[row["by_default"]], "verdict": "pass" if row["passed"] else "FAIL"}
        for row in rows
    ]
    title = f"Mean cost with its standard error; what is on by default may cost {LIMIT_DB} dB"
    return table(title, lines, COLUMNS["of_all"])


def chart(scene: dict[str, Any]) -> Figure:
    """Held-out PSNR over training seconds, a curve for each run of the first seed."""
    figure, (axes,) = panels(8, 5)
    curves = {DEFAULT.label: scene["default"][0]}
    curves |= {f"{r['feature']}: {r['other']}": r["runs"][0] for r in scene["features"]}
    for k, (name, run) in enumerate(curves.items()):
        points = [(h["seconds"], h["psnr"]) for h in run["history"] if h["psnr"] is not None]
        first = name == DEFAULT.label
        axes.plot(
            *zip(*points, strict=True), label=name, lw=2.4 if first else 1.1, zorder=3 if first else 2,
            color="black" if first else color(k - 1), marker="o", markersize=2.5,
        )  # fmt: skip
    axes.set(xlabel="training (s)", ylabel="held-out PSNR (dB)")
    title(axes, scene["scene"])
    axes.legend(**LEGEND)
    return figure
