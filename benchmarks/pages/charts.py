"""The charts of the pages, drawn from the tables."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame

from benchmarks.pages.figures import pick, records, unbeaten
from benchmarks.pages.sections import asked
from benchmarks.rows import pairs_of

BLUE, ORANGE, GREEN, GREY = "#1f6fb2", "#c2571a", "#3a8f3a", "#6b6b6b"
COLORS = (BLUE, ORANGE, GREEN, "#7b4fa3", "#b23a48", GREY, "#9a8a00", "#2a9d9d", "#d98cb3", "#000000")
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8}


def charts(tables: dict[str, DataFrame]) -> dict[str, Figure]:
    """Each figure by its file's name; none of what was not measured."""
    trained = pick(tables["accuracy"], inputs="built-in scene, trained")
    wanted = {
        "error_against_seconds": (against_seconds, tables["time"]),
        "accuracy_trained": (error_against_time, trained),
    }
    return {name: draw(runs) for name, (draw, runs) in wanted.items() if len(runs)}


def panels(
    width: float, height: float, down: int = 1, across: int = 1, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of inches with its panels row by row, each with a grid behind the data and two spines."""
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    found = list(figure.subplots(down, across, squeeze=False, **shared).ravel())
    for axes in found:
        axes.grid(color="#dddddd", linewidth=0.7)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, found


def color(k: int) -> str:
    """The colour of the k-th curve; beyond the last they start again."""
    return COLORS[k % len(COLORS)]


def against_seconds(times: DataFrame) -> Figure:
    """Held-out PSNR against seconds of training, a panel for each scene."""
    scenes = list(dict.fromkeys(pick(times, row="3dgs")["scene"]))
    figure, grid = panels(4 * len(scenes), 4, 1, len(scenes))
    for axes, scene in zip(grid, scenes, strict=True):
        for line in records(pick(times, scene=scene, row="3dgs")):
            points = [(float(at), psnr) for at, psnr in pairs_of(line["history"])]
            axes.plot(*zip(*points, strict=True), color=GREY, label="3dgs")
        mine = pick(times, scene=scene, row=asked(times)).sort_values("seconds")
        axes.plot(mine["seconds"], mine["psnr"], "o-", color=BLUE, label="hqgs --seconds")
        axes.set(xscale="log", xlabel="training (s)", ylabel="held-out PSNR (dB)")
        axes.set_xticks([3, 10, 30, 60, 180, 600], ["3", "10", "30", "60", "180", "600"])
        axes.set_title(str(scene), fontsize=10, loc="left", parse_math=False)
        axes.legend(**LEGEND)
    return figure


def error_against_time(accuracy: DataFrame) -> Figure:
    """Error against time on log axes: above against the exact result, below against the definition."""
    figure, grid = panels(11, 8, 2, 2, sharex=True)
    what = [
        (f"{name}_{oracle}", f"{word}, against the {oracle} result")
        for oracle in ("exact", "defined")
        for name, word in (("image", "image RMS error"), ("gradients", "relative error of the gradients"))
    ]
    for axes, (column, words) in zip(grid, what, strict=True):
        known = accuracy.loc[accuracy[column] > 0]  # what has no error has no place on a log axis
        points = list(zip(1000 * known["seconds"], known[column], strict=True))
        front = [points[k] for k in unbeaten(points)]
        label = "no other one is better in both"
        axes.plot(*zip(*front, strict=True), color="#888888", lw=1.2, drawstyle="steps-post", label=label)
        for k, (knob, part) in enumerate(known.groupby("knob", sort=False)):
            look: dict[str, Any] = (
                {"marker": "*", "ms": 13} if knob == "default" else {"marker": "o", "ms": 5}
            )
            axes.plot(1000 * part["seconds"], part[column], ls="", label=str(knob), color=color(k), **look)
        axes.set(xscale="log", yscale="log", xlabel="forward and backward (ms)")
        axes.set_title(words, fontsize=9, loc="left")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, **LEGEND)
    return figure
