"""Tables and sentences of the page about the rasterizer."""

from __future__ import annotations

from pandas import DataFrame

from benchmarks.pages.figures import NOTHING, and_list, number, pick, records, table
from benchmarks.rows import pairs_of
from benchmarks.speed.timing import exponent


def stages_table(passes: DataFrame) -> str:
    """Forward and backward by stage, and over the limit of its arithmetic."""
    lines = [line | dict(pairs_of(line["stages"])) for line in records(passes)]
    stages = [name for name, _ in pairs_of(passes.iloc[0]["stages"])]
    body = [
        [f"{line['gaussians']:,.0f}", *(number(line[name], "ms") for name in (*stages, "seconds")),
         f"{line['seconds'] / line['limit_seconds']:.2f}", f"{line['lane_use']:.0%}"] for line in lines
    ]  # fmt: skip
    return table(["Gaussians", *stages, "whole", "whole / limit", "lanes in use"], body)


def threads_tables(runs: DataFrame) -> list[str]:
    """Each case by stage and number of threads, and how many times as fast as one thread."""
    tables = []
    for case, part in runs.groupby("case", sort=False):
        stages = [name for name, _ in pairs_of(part.iloc[0]["stages"])]
        body = [
            [f"{line['threads']:.0f}", *(number(value, "ms") for _, value in pairs_of(line["stages"])),
             number(line["seconds"], "ms"), f"{line['ratio']:.2f}", f"{line['expected']:.2f}"]
            for line in records(part)
        ]  # fmt: skip
        tables.append(table([str(case), *stages, "whole", "times one", "expected of two"], body))
    return tables


def cases_in_ms(runs: DataFrame) -> str:
    """`42 (3dgs, 100,000) and 64 (3dgs, 200,000)`."""
    return and_list([f"{number(line['seconds'], 'ms')} ({line['case']})" for line in records(runs)])


def threads_words(runs: DataFrame) -> str:
    """How many times as fast two threads are."""
    many = runs.loc[runs["threads"] == 2]
    words = [f"{line['ratio']:.2f} ({line['case']})" for line in records(many)]
    return f"two are so many times as fast as one: {and_list(words)}" if words else "there was one"


def power(speed: DataFrame, against: str) -> str:
    """The power with which the time of a pass grows with `gaussians` or `pixels`."""
    runs = pick(speed, part="scaling")
    runs = runs.loc[runs["case"].str.startswith(against)]
    x = runs["gaussians"] if against == "gaussians" else runs["width"] * runs["height"]
    return f"{exponent(list(x), list(runs['seconds'])):.2f}"


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
