"""Pictures with EXIF, and folders of photos alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from hqgs.base.stages import OnStage, silent
from hqgs.scene.sfm.bare_photos import BarePhotos, bare_photos, readable


def exif(
    orientation: int = 1, focal_35mm: int = 0, model: str = "", gps: dict[int, object] | None = None
) -> Image.Exif:
    tags = Image.Exif()
    tags[274] = orientation
    if model:
        tags[272] = model
    if focal_35mm:
        tags.get_ifd(0x8769)[41989] = focal_35mm
    tags.get_ifd(0x8825).update(gps or {})
    return tags


def picture(seed: int, size: tuple[int, int] = (40, 30)) -> Image.Image:
    rng = np.random.default_rng(seed)
    return Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8))


def looked_at(folder: Path, on_stage: OnStage = silent) -> BarePhotos:
    """The photos of a folder that can be read."""
    found = bare_photos(folder, 1)
    assert found is not None
    return readable(found, on_stage)
