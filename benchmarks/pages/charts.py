"""The charts of the pages, drawn from the tables."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame

from benchmarks.pages.figures import gain, pick, records, unbeaten
from benchmarks.pages.sections import asked
from benchmarks.rows import pairs_of

BLUE, ORANGE, GREEN, GREY = "#1f6fb2", "#c2571a", "#3a8f3a", "#6b6b6b"
COLORS = (BLUE, ORANGE, GREEN, "#7b4fa3", "#b23a48", GREY, "#9a8a00", "#2a9d9d", "#d98cb3", "#000000")
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8}
NO_ERROR = 1e-18  # in the place of 0 on a log axis


def charts(tables: dict[str, DataFrame]) -> dict[str, Figure]:
    """Each figure by its file's name; none of what was not measured."""
    quality = pick(tables["quality"], downscale=2, poses="own")
    captures = ["fern", "fox", "horns"]
    standard = ["none", "jpeg:10", "noise:25", "lowres:4", "blur", "mixed"]
    life = ["shake", "some:shake", "some:defocus", "exposure", "some:noise:25", "phone", "chat", "video"]
    main = pick(quality, iterations=2000, scene=captures, degradation=standard, seed=0)
    wild = pick(quality, iterations=2000, scene=[*captures, "embedded"], degradation=["none", *life])
    trained = pick(tables["accuracy"], inputs="built-in scene, trained")
    wanted = {
        "quality_gains": (gain_map, main),
        "wild_gains": (gain_map, wild),
        "error_against_seconds": (against_seconds, tables["time"]),
        "accuracy_trained": (error_against_time, trained),
        "stability_errors": (case_errors, tables["stability"]),
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


def gain_map(runs: DataFrame, row: str = "hqgs", base: str = "3dgs") -> Figure:
    """A heat map: PSNR of a row over the base's for each scene and seed, and degradation."""
    found = gain(runs, row, base).runs
    kinds = [kind for kind in dict.fromkeys(runs["degradation"]) if kind in set(found["degradation"])]
    values = found.set_index(["scene", "seed", "degradation"])["gain"].unstack().reindex(columns=kinds)
    numbers = values.to_numpy()
    limit = float(np.nanmax(np.abs(numbers))) or 1.0
    figure, (axes,) = panels(2.2 + 0.85 * len(kinds), 1.4 + 0.34 * len(values))
    image = axes.imshow(numbers, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    axes.grid(visible=False)
    axes.set_title(f"{row} over {base}", fontsize=10, loc="left")
    axes.set_xticks(range(len(kinds)), kinds, fontsize=8, parse_math=False)
    names = [f"{scene}, seed {seed}" for scene, seed in values.index]
    axes.set_yticks(range(len(names)), names, fontsize=8, parse_math=False)
    for (i, j), value in np.ndenumerate(numbers):
        if np.isfinite(value):
            shade = "white" if abs(value) > 0.6 * limit else "black"
            axes.text(j, i, f"{value:+.2f}", ha="center", va="center", fontsize=8, color=shade)
    figure.colorbar(image, ax=axes, label="PSNR gain (dB)")
    return figure


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


def case_errors(stability: DataFrame) -> Figure:
    """Two panels, values and gradients: one row per case, f32 and f64."""
    shown = stability.dropna(subset=["gradient"])
    names = list(dict.fromkeys(shown["case"]))
    figure, grid = panels(10, 2 + 0.16 * len(names), 1, 2, sharey=True)
    for axes, (column, what) in zip(
        grid, (("value_relative", "values, relative"), ("gradient", "gradients, relative L2")), strict=True
    ):
        for dtype, shade in (("f32", ORANGE), ("f64", BLUE)):
            part = shown.loc[shown["dtype"] == dtype].set_index("case")[column].reindex(names)
            axes.plot(part.clip(lower=NO_ERROR), range(len(names)), "o", color=shade, ms=4, label=dtype)
        axes.set(xscale="log", xlabel=what)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.01), ncols=2, **LEGEND)
    grid[0].set_yticks(range(len(names)), names, fontsize=7)
    grid[0].set_ylim(len(names), -1)
    return figure
