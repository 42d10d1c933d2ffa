"""Pictures side by side in rows."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

GAP = 8  # pixels between the pictures


def sheet(rows: Sequence[Sequence[tuple[str, NDArray[np.uint8]]]]) -> Image.Image:
    """Captions above pictures [H, W, 3] of one size, as many in each row.

    The font is the largest, in proportion to the pictures, in which all captions fit; those that never do
    are cut where it shows, so that none runs into the next picture. Below 9 px nothing is read.
    """
    height, width = rows[0][0][1].shape[:2]
    size = min(max(height // 26, 14), 40)
    font = ImageFont.load_default(size)
    while size > 9 and max(font.getlength(caption) for row in rows for caption, _ in row) > width - 4:
        size -= 1
        font = ImageFont.load_default(size)
    line = round(1.8 * size)
    across, down = len(rows[0]), len(rows)
    made = Image.new("RGB", (across * (width + GAP) - GAP, down * (height + line + GAP) - GAP), "white")
    for r, row in enumerate(rows):
        for c, (caption, picture) in enumerate(row):
            strip = Image.new("RGB", (width, line), "white")
            while len(caption) > 4 and font.getlength(caption) > width - 4:
                caption = f"{caption[:-4]}..."
            ImageDraw.Draw(strip).text((2, line // 2), caption, fill=(25, 25, 25), font=font, anchor="lm")
            x, y = c * (width + GAP), r * (height + line + GAP)
            made.paste(strip, (x, y))
            made.paste(Image.fromarray(picture), (x, y + line))
    return made


def printable(text: str) -> str:
    """The text with everything but printable ASCII replaced (fonts lack the rest), cut to 60."""
    text = re.sub(r"[^ -~]", "?", text)
    return text if len(text) <= 60 else text[:57] + "..."
