"""Charts of the quality benchmark: error against time, gains, where the Gaussians are; and picture sheets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame
from PIL import Image, ImageDraw, ImageFont

from benchmarks.charts import LEGEND, color, panels, title
from benchmarks.quality.cell import render_path
from benchmarks.quality.tables import means, with_degraded
from benchmarks.scenes import degraded_view
from benchmarks.study import Store
from hqgs.base.files import atomic_path
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.report import AMPLIFICATION, MASKED
from hqgs.photos.pixels import to_uint8
from hqgs.scene.scene import Scene

ACROSS = 3  # panels in a row
GAP = 6  # pixels between the panels of a sheet
Uint8 = NDArray[np.uint8]


def time_chart(frame: DataFrame, what: str) -> Figure:
    """Held-out PSNR against training seconds, a panel for each degradation, a curve for each method.

    A point is the mean over scenes and seeds of PSNR and of time, after the same number of iterations.
    """
    parts = frame.groupby("degradation", sort=False)
    across = min(ACROSS, len(parts))
    down = -(-len(parts) // across)
    figure, grid = panels(1.2 + 3.6 * across, 0.9 + 2.8 * down, down, across)
    for axes in grid[len(parts) :]:
        axes.set_visible(False)
    for axes, (kind, part) in zip(grid, parts, strict=False):
        for k, (label, runs) in enumerate(part.groupby("row", sort=False)["run"]):
            points = [h for h in zip(*(run["history"] for run in runs), strict=True)]
            points = [h for h in points if all(p["psnr"] is not None for p in h)]
            seconds, values = (
                [np.mean([p[name] for p in point]) for point in points] for name in ("seconds", "psnr")
            )
            axes.plot(seconds, values, color=color(k), marker="o", markersize=3, lw=1.5, label=str(label))
        title(axes, str(kind))
        axes.set_xlim(left=0)
    grid[0].legend(**LEGEND)
    figure.suptitle(what, fontsize=11, x=0.01, ha="left", parse_math=False)
    figure.supxlabel("training time (s)", fontsize=10)
    figure.supylabel("held-out PSNR (dB)", fontsize=10)
    return figure


def gain_chart(frame: DataFrame, baseline: str) -> Figure:
    """A heat map for each method but the baseline: its PSNR over the baseline's in each group."""
    others = frame.loc[frame["row"] != baseline]
    kinds = list(frame["degradation"].unique())
    lines = frame[["scene", "seed"]].drop_duplicates()
    limit = others["gain"].abs().max()
    limit = limit if limit > 0 else 1.0  # NaN, where there is no gain, is not
    parts = others.groupby("row", sort=False)
    size = 2.2 + 0.85 * len(kinds), (1.1 + 0.34 * len(lines)) * len(parts) + 0.3
    figure, grid = panels(*size, len(parts))
    image = None
    for axes, (label, part) in zip(grid, parts, strict=True):
        values = part.set_index(["scene", "seed", "degradation"])["gain"].unstack()
        values = values.reindex(index=list(lines.itertuples(index=False, name=None)), columns=kinds)
        image = axes.imshow(values.to_numpy(), cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
        axes.grid(visible=False)
        title(axes, f"{label} over {baseline}")
        names = [f"{scene}, seed {seed}" for scene, seed in values.index]
        axes.set_xticks(range(len(kinds)), kinds, fontsize=8, parse_math=False)
        axes.set_yticks(range(len(names)), names, fontsize=8, parse_math=False)
        for (i, j), value in np.ndenumerate(values.to_numpy()):
            if np.isfinite(value):
                shade = "white" if abs(value) > 0.6 * limit else "black"
                axes.text(j, i, f"{value:+.2f}", ha="center", va="center", fontsize=8, color=shade)
    if image is not None:
        figure.colorbar(image, ax=grid, label="PSNR gain (dB)")
    return figure


def region_chart(frame: DataFrame) -> Figure:
    """Gaussians per 1,000 pixels on edges and in flat parts, for each degradation and method."""
    heights = means(with_degraded(frame), ["row", "degradation"], ["edge_density", "flat_density"])
    labels, kinds = (list(heights.index.unique(level)) for level in ("row", "degradation"))
    figure, (axes,) = panels(2 + 1.3 * len(kinds), 3.4)
    axes.grid(visible=False, axis="x")
    width = 0.8 / (2 * len(labels))
    for k, label in enumerate(labels):
        for r, (region, name) in enumerate((("edge", "edges"), ("flat", "flat"))):
            axes.bar(
                np.arange(len(kinds)) - 0.4 + (2 * k + r + 0.5) * width,
                heights.loc[label].reindex(kinds)[f"{region}_density"],
                width, color=color(k), alpha=(1.0, 0.45)[r], label=f"{label}, {name}",
            )  # fmt: skip
    axes.set_xticks(range(len(kinds)), kinds, parse_math=False)
    axes.set_ylabel("Gaussians per 1,000 pixels")
    figure.legend(loc="outside right upper", **LEGEND)
    return figure


def write_sheet(
    path: Path, store: Store, clean: Scene, runs: Mapping[str, dict[str, Any]], number: int
) -> bool:
    """Write the sheet of one held-out view; False where a render was not kept.

    Above: photo, degraded photo, the render of each run. Below each of those after the first: its difference
    from the photo. No run has seen the degraded photo; it shows what happened to the training photos.
    """
    files = {label: render_path(store, run["key"], number) for label, run in runs.items()}
    if not all(file.is_file() for file in files.values()):
        return False
    first = next(iter(runs.values()))
    view = clean.test[number]
    bad = degraded_view(clean, view, first["degradation"], first["seed"]).image
    photo = _uint8(view.image)
    above = [(f"photo {view.name}", photo)]
    above.append((_caption(first["degradation"], psnr(bad, photo, view.mask)), _uint8(bad)))
    for label, run in runs.items():
        with Image.open(files[label]) as image:
            above.append((_caption(label, run["views"][number]["psnr"]), np.asarray(image.convert("RGB"))))
    below = [("", np.full_like(photo, 255))]
    for _, panel in above[1:]:
        error = np.minimum(AMPLIFICATION * np.abs(panel.astype(np.int64) - photo), 255).astype(np.uint8)
        if view.mask is not None:
            error[~view.mask] = MASKED
        below.append((f"difference x{AMPLIFICATION}", error))
    with atomic_path(path) as tmp:
        _grid([above, below]).save(tmp)
    return True


def _caption(label: str, value: float | None) -> str:
    return label if value is None else f"{label}  {value:.2f} dB"


def _grid(rows: list[list[tuple[str, Uint8]]]) -> Image.Image:
    """Panels of one size, a caption above each, cut off where it is too long."""
    height, width = rows[0][0][1].shape[:2]
    size = min(max(height // 20, 10), 28)
    line = round(1.7 * size)
    font = ImageFont.load_default(size)
    across, down = len(rows[0]), len(rows)
    sheet = Image.new("RGB", (across * (width + GAP) - GAP, down * (height + line + GAP) - GAP), "white")
    for r, row in enumerate(rows):
        for c, (caption, panel) in enumerate(row):
            strip = Image.new("RGB", (width, line), "white")  # a caption never runs into the next panel
            text = caption.encode("ascii", "replace").decode()
            ImageDraw.Draw(strip).text((2, line // 2), text, fill=(25, 25, 25), font=font, anchor="lm")
            sheet.paste(strip, (c * (width + GAP), r * (height + line + GAP)))
            sheet.paste(Image.fromarray(panel), (c * (width + GAP), r * (height + line + GAP) + line))
    return sheet


def _uint8(image: NDArray[Any]) -> Uint8:
    return image if image.dtype == np.uint8 else to_uint8(image)
