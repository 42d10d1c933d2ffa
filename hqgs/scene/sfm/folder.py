"""Photos alone, or a film, as a folder that COLMAP's own tools and any trainer read."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pycolmap
from PIL import Image

from hqgs.base.stages import OnStage, silent
from hqgs.photos.files import decode
from hqgs.scene.checks import nothing
from hqgs.scene.constants import JPEG_QUALITY
from hqgs.scene.film import check_film, film_frames, frame_details, write_details
from hqgs.scene.names import existing_folder
from hqgs.scene.photo_files import film_at
from hqgs.scene.scene import SfmReport
from hqgs.scene.sfm.bare_photos import bare_photos, readable
from hqgs.scene.sfm.photos_alone import Search, find_cameras


def write_colmap_folder(
    source: str | Path, out: Path, work: Path, frames: int | None = None, on_stage: OnStage = silent
) -> SfmReport:
    """Write `images` and `sparse/0` of photos alone, or of a film, into the folder `out`.

    `images` has every photo with a place: those of WebP or HEIC as JPEG, the others as they are; of panoramas
    their faces, of a film also what its frames had of fine details. `work` is a folder for what the next call
    goes on with if this one is stopped; it is removed at the end. ValueError where there are no photos, or
    COLMAP finds no scene in them.
    """
    if frames is not None:
        check_film(source)
    with TemporaryDirectory(prefix="hqgs-film-") as name:
        if (film := film_at(source)) is not None:
            source, _ = film_frames(film, Path(name), frames, on_stage)
        root = existing_folder(source)
        photos = bare_photos(root, 1.0)
        if photos is None:
            raise ValueError(nothing(root))
        found = find_cameras(root, readable(photos, on_stage), Search(work, on_stage))
        images = out / "images"
        details = frame_details(found.photos.folder)
        kept: dict[str, float] = {}
        if found.photos.around:
            placed = {found.photos.colmap_names[image.name] for image in found.model.images.values()}
            replace(found.photos, names=sorted(placed)).write(images)
        for image in [] if found.photos.around else found.model.images.values():
            original = found.photos.colmap_names[image.name]
            target = images / image.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if original in details:
                kept[image.name] = details[original]
            if found.photos.as_it_is(original):
                shutil.copyfile(found.photos.folder / original, target)
            else:
                pixels = decode(found.photos.folder / original)[0]
                Image.fromarray(pixels).save(target, quality=JPEG_QUALITY, subsampling=0)
        if kept:
            write_details(images, kept)
        (out / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        model: pycolmap.Reconstruction = found.model
        model.write_binary(out / "sparse" / "0")
        shutil.rmtree(work, ignore_errors=True)
        return found.report
