"""Tables and sentences that one page needs, of the frames of the tables."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from pandas import DataFrame

from benchmarks.pages.figures import NOTHING, and_list, number, pick, records, table
from benchmarks.rows import RUN, pairs_of


def stages_table(passes: DataFrame) -> str:
    """Forward and backward by stage."""
    lines = [line | dict(pairs_of(line["stages"])) for line in records(passes)]
    stages = [name for name, _ in pairs_of(passes.iloc[0]["stages"])]
    body = [
        [f"{line['gaussians']:,.0f}", *(number(line[name], "ms") for name in (*stages, "seconds"))]
        for line in lines
    ]
    return table(["Gaussians", *stages, "whole"], body)


def cases_in_ms(runs: DataFrame) -> str:
    """`42 (3dgs, 100,000) and 64 (3dgs, 200,000)`."""
    return and_list([f"{number(line['seconds'], 'ms')} ({line['case']})" for line in records(runs)])


def threads_words(runs: DataFrame) -> str:
    """How many times as fast two threads are."""
    many = runs.loc[runs["threads"] == 2]
    words = [f"{line['ratio']:.2f} ({line['case']})" for line in records(many)]
    return f"two are so many times as fast as one: {and_list(words)}" if words else "there was one"


def unbeaten_default(accuracy: DataFrame) -> str:
    """Whether a setting is better than the default in all errors and, in three rounds of four, in time."""
    errors, better = ["image_exact", "gradients_exact", "image_defined", "gradients_defined"], []
    for _, part in accuracy.groupby("inputs", sort=False):
        default = part.iloc[0]
        for line in records(part.iloc[1:]):
            if all(line[name] <= default[name] for name in errors) and line["ratio_high"] < 1:
                better.append(f"{line['knob']} {line['value']} ({line['inputs']})")
    if better:
        return f"Better than the default in error and in time: {and_list(better)}."
    return "No setting is better than the default in error and in time."


def families(stability: DataFrame) -> str:
    """The largest errors of each family of cases."""
    body = []
    for group, part in stability.groupby("group", sort=False):
        f32, f64 = (part.loc[part["dtype"] == dtype] for dtype in ("f32", "f64"))
        values = [f32["value_abs"], f32["gradient"], f64["value_relative"], f64["gradient"]]
        if all(column.isna().all() for column in values):  # inputs that are not finite have no oracle
            values = []
        words = [format(column.max(), ".1e") for column in values] or [NOTHING] * 4
        lost = part.loc[~part["met"], "case"].nunique()
        body.append([str(group), str(part["case"].nunique()), *words, f"{lost} missed" if lost else "met"])
    return table(
        ["family", "cases", "f32 max", "f32 gradient", "f64 values", "f64 gradient", "targets"], body
    )


def missed(stability: DataFrame) -> str:
    """The cases that miss a target, by name."""
    return (
        and_list([f'"{case}"' for case in dict.fromkeys(stability.loc[~stability["met"], "case"])]) or "none"
    )


def endured(endurance: DataFrame) -> str:
    """Whether the long runs passed."""
    failed = endurance.loc[~endurance["passed"], "row"]
    whole = f"All {len(endurance)} long runs end with finite numbers, flat memory and a bounded size."
    return f"Long runs that fail: {and_list(list(failed))}." if len(failed) else whole


SHORT = 0.1  # dB: a level is what 3DGS ends at, less this
BASE = "3dgs"


def beside_base(times: DataFrame) -> DataFrame:
    """The runs that had a number of seconds, by it, with their `lead` over BASE after as many of its own.

    `base`: its PSNR then, NaN before its first evaluation.
    """
    histories = pick(times, row=BASE).set_index("scene")["history"].map(pairs_of)
    runs = pick(times, row=[row for row in set(times["row"]) if row != BASE])
    runs = runs.assign(asked=runs["row"].str.removesuffix(" s").astype(float)).sort_values(
        "asked", kind="stable"
    )
    known = [
        [psnr for at, psnr in histories[scene] if float(at) <= asked]
        for scene, asked in zip(runs["scene"], runs["asked"], strict=True)
    ]
    runs["base"] = [psnrs[-1] if psnrs else None for psnrs in known]
    return runs.assign(lead=runs["psnr"] - runs["base"])


def placed(poses: DataFrame) -> str:
    """`33 of 34`: in how many cells all photos have a place; and, of the others, how many lack."""
    lines = records(poses)
    found = [
        f"{line['photos'] - line['registered']} of {line['photos']} ({line['scene']}, {line['degradation']})"
        for line in lines
        if line["registered"] < line["photos"]
    ]
    lack = f"; without a place are {and_list(found)}" if found else ""
    return f"{len(lines) - len(found)} of {len(lines)}{lack}"


def poses_beside(runs: DataFrame, value: str = "psnr") -> DataFrame:
    """A metric of runs with the scenes' own poses and with those from the photos, where there are both."""
    same = [name for name in RUN if name != "poses"]
    own, photos = (runs.loc[runs["poses"] == one].set_index(same)[value] for one in ("own", "photos"))
    both = pd.concat([own, photos], axis=1, join="inner", keys=["own", "photos"]).dropna().reset_index()
    return both.assign(cost=both["photos"] - both["own"])


def costs_in_words(runs: DataFrame) -> str:
    """The mean and the worst cost of poses from the photos, as held-out cameras are, and with them fitted."""
    costs = [poses_beside(runs, value)["cost"] for value in ("psnr", "psnr_fitted")]
    words = [f"{cost.mean():+.2f} dB (at worst {cost.min():+.2f})" for cost in costs]
    return f"{words[0]}, fitted {words[1]}"


def cost_of_poses(runs: DataFrame) -> str:
    """PSNR with the scenes' own poses, and what poses from the photos cost: as they are, and fitted."""
    plain, fitted = (poses_beside(runs, value) for value in ("psnr", "psnr_fitted"))
    scenes = list(dict.fromkeys(plain["scene"]))
    rows = []
    for kind in dict.fromkeys(plain["degradation"]):
        cells = []
        for scene in scenes:
            one, moved = (records(pick(part, scene=scene, degradation=kind)) for part in (plain, fitted))
            costs = [number(line[0]["cost"] if line else None, "+.2f") for line in (one, moved)]
            cells.append(f"{number(one[0]['own'] if one else None, '.2f')}: {'/'.join(costs)}")
        rows.append([str(kind), *cells])
    return table(["", *scenes], rows)


def reconstructions(poses: DataFrame) -> str:
    """Poses from degraded photos against the scenes' own."""
    rows = []
    for line in records(poses):
        rotation, center = (
            f"{line[f'{name}_median']:{form}}/{line[f'{name}_max']:{form}}"
            for name, form in (("rotation", ".3f"), ("centre", ".1%"))
        )
        name = f"{line['scene']}/{line['degradation']}"
        auc = "/".join(number(line.get(f"auc_{degrees}"), ".2f") for degrees in (1, 3, 5))
        rows.append([name, rotation, auc, center, number(line.get("search_cpu_s"), ".0f")])
    first = ("rotation (deg)", "AUC at 1/3/5 deg", "centre")
    return table(["", *first, "CPU (s)"], rows)


def levels(times: DataFrame, scenes: Sequence[str], base: str = BASE) -> str:
    """When each scene comes within SHORT of where the base ends, and when the base itself does, a line each;
    what precedes the first step counts."""
    body = []
    for scene in scenes:
        for line in records(pick(times, scene=scene, row=base)):
            level = line["psnr"] - SHORT
            mine = times.loc[(times["scene"] == scene) & (times["row"] != base)]
            enough = (mine["seconds"] + mine["setup_seconds"]).loc[mine["psnr"] >= level]
            own = min(float(at) for at, psnr in pairs_of(line["history"]) if psnr >= level)
            took = f"{enough.min():.0f}" if len(enough) else NOTHING
            body.append([scene, f"{level:.2f}", took, f"{own + line['setup_seconds']:.0f}"])
    return table(["", f"`{base}` at its end, less {SHORT} (dB)", "`hqgs` (s)", f"`{base}` (s)"], body)


def files(export: DataFrame) -> str:
    """Size of each file and what it costs in held-out PSNR, the largest first."""
    body = []
    for line in records(export.sort_values("bytes", ascending=False, kind="stable")):
        sizes = f"{line['bytes'] / 1e6:.2f}", f"{line['bytes'] / line['ply_bytes']:.1%}"
        body.append([line["file"], *sizes, f"{0.0 - line['cost_db']:+.3f}"])
    return table(["file", "MB", "of 3DGS's PLY", "PSNR (dB)"], body)


def files_head(export: DataFrame) -> str:
    """What the files are of: `fern, 252 x 189 px, 78,002 Gaussians of degree 3.`"""
    first = records(export)[0]
    size = f"{first['width']:,} x {first['height']:,} px"
    what = f"{first['gaussians']:,} Gaussians of degree {first['sh_degree']}"
    return f"{first['scene'].capitalize()}, {size}, {what}."


def seeds_apart(quality: DataFrame, row: str = BASE) -> float:
    """By how much PSNR differs at most between seeds of a row on the same clean photos."""
    runs = pick(quality, row=row, degradation="none")
    cells = [part["psnr"] for _, part in runs.groupby(["scene", "iterations", "downscale", "poses"])]
    return max(float(psnr.max() - psnr.min()) for psnr in cells)
