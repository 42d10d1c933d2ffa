"""Small pictures of photos side by side on one sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PIL import Image

from hqgs.evaluation.constants import SHEET_COLUMNS, TILE_GAP


def sheet_of(tiles: Sequence[Image.Image]) -> Image.Image:
    """One or more tiles in rows of SHEET_COLUMNS, on white."""
    width, height = (max(getattr(tile, side) for tile in tiles) + TILE_GAP for side in ("width", "height"))
    columns = min(SHEET_COLUMNS, len(tiles))
    sheet = Image.new("RGB", (columns * width, math.ceil(len(tiles) / columns) * height), "white")
    for k, tile in enumerate(tiles):
        sheet.paste(tile, (k % columns * width, k // columns * height))
    return sheet
