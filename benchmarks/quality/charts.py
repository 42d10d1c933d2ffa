"""Charts of the quality benchmark: error against time, gains, and where the Gaussians are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from benchmarks.quality.summary import DEGRADED, Group, columns, density, mean_of, psnr_gain

COLORS = ("#1f6fb2", "#c2571a", "#3a8f3a", "#7b4fa3", "#b23a48", "#6b6b6b", "#9a8a00")
ACROSS = 3  # panels in a row
GREY = "#dddddd"


def time_chart(groups: Sequence[Group], labels: Sequence[str], title: str) -> Figure:
    """Held-out PSNR against training seconds, a panel for each degradation, a curve for each method.

    A point is the mean over scenes and seeds of PSNR and of time, after the same number of iterations.
    """
    parts = {kind: part for kind, part in columns(groups).items() if kind != DEGRADED}
    across = min(ACROSS, len(parts))
    down = -(-len(parts) // across)
    figure = Figure(figsize=(1.2 + 3.6 * across, 0.9 + 2.8 * down), dpi=150, layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes in panels[len(parts) :]:
        axes.set_visible(False)
    for axes, (kind, part) in zip(panels, parts.items(), strict=False):
        for k, label in enumerate(labels):
            histories = [group.runs[label]["history"] for group in part]
            points = [h for h in zip(*histories, strict=True) if all(p["psnr"] is not None for p in h)]
            seconds = [np.mean([p["seconds"] for p in point]) for point in points]
            values = [np.mean([p["psnr"] for p in point]) for point in points]
            color = COLORS[k % len(COLORS)]
            axes.plot(seconds, values, color=color, marker="o", markersize=3, linewidth=1.5, label=label)
        axes.set_title(kind, fontsize=10, loc="left", parse_math=False)
        axes.set_xlim(left=0)
        axes.grid(color=GREY, linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    figure.supxlabel("training time (s)", fontsize=10)
    figure.supylabel("held-out PSNR (dB)", fontsize=10)
    return figure


def gain_chart(groups: Sequence[Group], labels: Sequence[str], baseline: str) -> Figure:
    """A heat map for each method but the baseline: its PSNR over the baseline's in each group."""
    rows = list(dict.fromkeys((group.scene, group.seed) for group in groups))
    kinds = list(dict.fromkeys(group.degradation for group in groups))
    others = [label for label in labels if label != baseline]
    maps = {label: np.full((len(rows), len(kinds)), np.nan) for label in others}
    for group in groups:
        where = rows.index((group.scene, group.seed)), kinds.index(group.degradation)
        for label in others:
            gain = psnr_gain(group.runs[label], group.runs[baseline])
            maps[label][where] = np.nan if gain is None else gain
    limit = (
        max((float(np.nanmax(np.abs(m))) for m in maps.values() if np.isfinite(m).any()), default=1.0) or 1.0
    )

    size = (2.2 + 0.85 * len(kinds), (1.1 + 0.34 * len(rows)) * len(others) + 0.3)
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    panels = figure.subplots(len(others), 1, squeeze=False).ravel()
    image = None
    for axes, (label, values) in zip(panels, maps.items(), strict=True):
        image = axes.imshow(values, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
        axes.set_title(f"{label} over {baseline}", fontsize=10, loc="left", parse_math=False)
        axes.set_xticks(range(len(kinds)), kinds, fontsize=8, parse_math=False)
        axes.set_yticks(range(len(rows)), [f"{s}, seed {k}" for s, k in rows], fontsize=8, parse_math=False)
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                color = "white" if abs(value) > 0.6 * limit else "black"
                axes.text(j, i, f"{value:+.2f}", ha="center", va="center", fontsize=8, color=color)
    if image is not None:
        figure.colorbar(image, ax=list(panels), label="PSNR gain (dB)")
    return figure


def region_chart(groups: Sequence[Group], labels: Sequence[str]) -> Figure:
    """Gaussians per 1,000 pixels on edges and in flat parts, for each degradation and method."""
    parts = columns(groups)
    figure = Figure(figsize=(2 + 1.3 * len(parts), 3.4), dpi=150, layout="constrained")
    axes = figure.subplots()
    width = 0.8 / (2 * len(labels))
    for k, label in enumerate(labels):
        for r, region in enumerate(("edge", "flat")):
            heights = [mean_of(part, label, lambda run, r=region: density(run, r)) for part in parts.values()]
            axes.bar(
                np.arange(len(parts)) - 0.4 + (2 * k + r + 0.5) * width,
                [np.nan if h is None else h for h in heights],
                width,
                color=COLORS[k % len(COLORS)],
                alpha=(1.0, 0.45)[r],
                label=f"{label}, {'edges' if region == 'edge' else 'flat'}",
            )
    axes.set_xticks(range(len(parts)), list(parts), parse_math=False)
    axes.set_ylabel("Gaussians per 1,000 pixels")
    axes.grid(axis="y", color=GREY, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return figure
