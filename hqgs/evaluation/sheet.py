"""Small pictures of photos side by side on one sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PIL import Image

MOST, COLUMNS, SIDE, GAP = 12, 4, 260, 6  # photos, and side by side; px: of a photo, and between two


def sheet_of(tiles: Sequence[Image.Image]) -> Image.Image:
    """One or more tiles in rows of COLUMNS, on white."""
    width, height = (max(getattr(tile, side) for tile in tiles) + GAP for side in ("width", "height"))
    columns = min(COLUMNS, len(tiles))
    sheet = Image.new("RGB", (columns * width, math.ceil(len(tiles) / columns) * height), "white")
    for k, tile in enumerate(tiles):
        sheet.paste(tile, (k % columns * width, k // columns * height))
    return sheet
