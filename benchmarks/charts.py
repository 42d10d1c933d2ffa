"""One style for all charts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, GREY = "#1f6fb2", "#c2571a", "#3a8f3a", "#6b6b6b"
COLORS = (BLUE, ORANGE, GREEN, "#7b4fa3", "#b23a48", GREY, "#9a8a00", "#2a9d9d", "#d98cb3", "#000000")
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8}


def color(k: int) -> str:
    """The colour of the k-th curve; beyond the last they start again."""
    return COLORS[k % len(COLORS)]


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


def title(axes: Axes, text: str) -> None:
    """Above the panel, to the left; a $ in a name of a scene is no formula."""
    axes.set_title(text, fontsize=10, loc="left", parse_math=False)


def unbeaten(points: Sequence[tuple[float, float]]) -> list[int]:
    """The indices of the points that no other one beats, with less of one and no more of the other: a Pareto
    front by rising first coordinate."""

    def beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return a != b and a[0] <= b[0] and a[1] <= b[1]

    front = [k for k, point in enumerate(points) if not any(beats(other, point) for other in points)]
    return sorted(front, key=lambda k: points[k])
