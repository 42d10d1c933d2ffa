"""What was learned of the photos' cameras, drawn over the photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hqgs.base.evenly import evenly
from hqgs.evaluation.constants import AMPLIFICATION, CAPTION, SHEET_PHOTOS, TILE_SIDE
from hqgs.evaluation.records import LearnedRecord
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.photos.sheet import tiled


def learned_picture(
    photos: Sequence[NDArray[np.uint8] | NDArray[np.float32]], learned: Sequence[LearnedRecord]
) -> Image.Image:
    """Up to 12 photos [H, W, 3], the least sharp one first, each with its camera's trajectory and largest
    disc out of focus (four times as large) in its middle and its gain in the caption.
    """
    order = sorted(range(len(learned)), key=lambda k: -learned[k]["shake_px"] - 2 * learned[k]["defocus_px"])
    chosen = [order[k] for k in evenly(len(order), SHEET_PHOTOS)]
    return tiled([_tile(photos[k], learned[k]) for k in chosen])


def _tile(photo: NDArray[np.uint8] | NDArray[np.float32], record: LearnedRecord) -> Image.Image:
    picture = Image.fromarray(to_uint8(as_floats(photo)))
    scale = TILE_SIDE / max(picture.size)
    picture = picture.resize((max(round(picture.width * scale), 1), max(round(picture.height * scale), 1)))
    tile = Image.new("RGB", (picture.width, picture.height + CAPTION), "white")
    tile.paste(picture, (0, CAPTION))
    draw = ImageDraw.Draw(tile)
    stops = float(np.log2(record["gains"]).mean())
    facts = [f"{record['shake_px']:.1f} px" if record["shake_px"] else "still"]
    facts += [f"focus {record['defocus_px']:.1f} px"] if record["defocus_px"] else []
    facts += [f"{stops:+.2f} stops"] if np.ptp(record["gains"]) or stops else []
    draw.text((2, 3), f"{Path(record['name']).stem[-16:]}  {', '.join(facts)}", fill=(25, 25, 25))
    middle = np.array([picture.width / 2, CAPTION + picture.height / 2])
    scale *= AMPLIFICATION
    trajectory = [tuple(middle + scale * np.array(point)) for point in record["trajectory_px"]]
    if record["defocus_px"]:
        radius = scale * record["defocus_px"]
        for width, color in ((3, (0, 0, 0)), (1, (255, 210, 0))):
            draw.circle(tuple(middle), radius, outline=color, width=width)
    if record["shake_px"]:
        draw.line(trajectory, fill=(0, 0, 0), width=5, joint="curve")
        draw.line(trajectory, fill=(255, 210, 0), width=3, joint="curve")
    return tile
