"""What was taken for passers-by: masks for other programs, and a picture to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hqgs.base.files import atomic_path
from hqgs.evaluation.constants import PAINT, RED, SHEET_PHOTOS, TILE_SIDE
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.photos.sheet import tiled
from hqgs.scene.capture import inside
from hqgs.scene.photo_files import MASKS
from hqgs.scene.scene import View


def save_masks(folder: Path, views: Sequence[View]) -> None:
    """Write `masks/NAME.png` of each view, as COLMAP takes them: white counts, black does not. Atomically."""
    for view in views:
        mask = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask
        with atomic_path(inside(folder / MASKS, f"{view.name}.png", "the photo's name")) as tmp:
            Image.fromarray(mask.astype(np.uint8) * 255).save(tmp, "PNG")


def passing_picture(views: Sequence[View], passing: Mapping[str, NDArray[np.bool_]]) -> Image.Image:
    """Up to 12 photos, those first of which most was masked, with that part in red."""
    shown = [view for view in views if view.name in passing]
    shown = sorted(shown, key=lambda view: -passing[view.name].mean())[:SHEET_PHOTOS]
    return tiled([_tile(view, passing[view.name]) for view in shown])


def _tile(view: View, passing: NDArray[np.bool_]) -> Image.Image:
    photo = to_uint8(as_floats(view.image)).astype(np.float64)
    photo[passing] += PAINT * (np.array(RED) - photo[passing])
    tile = Image.fromarray(photo.astype(np.uint8))
    tile.thumbnail((TILE_SIDE, TILE_SIDE))
    return tile
