"""Pictures of the quality benchmark: a chart of the gains, and sheets of renders."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame
from PIL import Image

from benchmarks.charts import panels, title
from benchmarks.quality.cell import render_path
from benchmarks.scenes import degraded_view
from benchmarks.study import Store
from hqgs.base.files import atomic_path
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.report import AMPLIFICATION, MASKED
from hqgs.photos.pixels import to_uint8
from hqgs.photos.sheet import printable, sheet
from hqgs.scene.scene import Scene

Uint8 = NDArray[np.uint8]


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
    above = [(printable(f"photo {view.name}"), photo)]
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
        sheet([above, below]).save(tmp)
    return True


def _caption(label: str, value: float | None) -> str:
    return printable(label if value is None else f"{label}  {value:.2f} dB")


def _uint8(image: NDArray[Any]) -> Uint8:
    return image if image.dtype == np.uint8 else to_uint8(image)
