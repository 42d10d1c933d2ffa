"""Photos that a pass found no place for are placed by weaker evidence.

COLMAP asks 30 matches with the model's points that agree, and a quarter of all. Bad photos often have half
of it, and whole parts of a capture hang on one of them. What weak gates let in is judged at last, by what
the photos show (`agree.py`). It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's
process.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pycolmap

from hqgs.scene.sfm.constants import GATES
from hqgs.scene.sfm.facts import placed_names


def brought_home(
    model: pycolmap.Reconstruction,
    database: Path,
    photos: Path,
    folder: Path,
    mapping: Callable[[], pycolmap.IncrementalPipelineOptions],
) -> pycolmap.Reconstruction:
    """The model with more of the photos of its database; as it is where none more finds a place.

    `folder` is for COLMAP's files and is made anew; `mapping` gives the options that made the model. What
    contradicts the new places is not left out yet: parts that hang on one photo may be bent there, and those
    observations are what will straighten them.
    """
    before, now = placed_names(model), model
    for number, (least, share) in enumerate(GATES):
        start, out = folder / f"start{number}", folder / f"found{number}"
        for new in (start, out):
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir(parents=True)
        now.write(start)
        options = mapping()
        options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = least, share
        found = pycolmap.incremental_mapping(database, photos, out, options=options, input_path=start)
        held = [one for one in found.values() if placed_names(one) >= before]
        now = max([now, *held], key=lambda one: one.num_reg_images())
        with pycolmap.Database.open(database) as db:
            if now.num_reg_images() == db.num_images():
                break
    return now


def without(model: pycolmap.Reconstruction, names: set[str]) -> None:
    """Take these photos' places away."""
    for image in [model.images[k] for k in model.reg_image_ids()]:
        if image.name in names:
            model.deregister_frame(image.frame_id)
