"""Picture sheets: a held-out photo, what the degradation would make of it, and each method's render."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.quality.cell import render_path
from benchmarks.scenes import degraded_view
from benchmarks.study import Store
from hqgs.base.files import atomic_path
from hqgs.evaluation.metrics import psnr
from hqgs.evaluation.report import AMPLIFICATION, MASKED
from hqgs.photos.pixels import to_uint8
from hqgs.scene.scene import Scene

GAP = 6  # pixels between panels
Uint8 = NDArray[np.uint8]


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
    panels = [(f"photo {view.name}", photo)]
    panels.append((_caption(first["degradation"], psnr(bad, photo, view.mask)), _uint8(bad)))
    for label, run in runs.items():
        with Image.open(files[label]) as image:
            panels.append((_caption(label, run["views"][number]["psnr"]), np.asarray(image.convert("RGB"))))
    below = [("", np.full_like(photo, 255))]
    for _, panel in panels[1:]:
        error = np.minimum(AMPLIFICATION * np.abs(panel.astype(np.int64) - photo), 255).astype(np.uint8)
        if view.mask is not None:
            error[~view.mask] = MASKED
        below.append((f"difference x{AMPLIFICATION}", error))
    with atomic_path(path) as tmp:
        _grid([panels, below]).save(tmp)
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
