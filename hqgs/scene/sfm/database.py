"""COLMAP's database before anything is found: photos, and their cameras.

It imports nothing of hqgs: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

FOCAL = 1.2  # of the longer side, where nothing tells


def known_cameras(given: dict[str, Any], database: Path) -> pycolmap.Reconstruction:
    """A reconstruction without points, and a database that gives its cameras and images the same numbers."""
    known = pycolmap.Reconstruction()
    names, sizes, Ks = (given[key] for key in ("names", "sizes", "Ks"))
    viewmats = given.get("viewmats", np.broadcast_to(np.eye(4), (len(names), 4, 4)))
    with pycolmap.Database.open(database) as db:
        for k, (size, K, viewmat) in enumerate(zip(sizes.tolist(), Ks, viewmats, strict=True), 1):
            pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
            camera = pycolmap.Camera(
                camera_id=k, model="PINHOLE", width=size[0], height=size[1], params=pinhole
            )
            camera.has_prior_focal_length = True
            image = pycolmap.Image(name=str(names[k - 1]), camera_id=k, image_id=k)
            known.add_camera_with_trivial_rig(camera)
            known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3]))
            db.write_camera(camera, use_camera_id=True)
            db.write_rig(known.rigs[k], use_rig_id=True)
            db.write_image(image, use_image_id=True)
            db.write_frame(known.frames[k], use_frame_id=True)
    return known


def new_cameras(given: dict[str, Any], database: Path) -> None:
    """A database with the photos and their cameras, whose focal lengths and distortion COLMAP finds."""
    with pycolmap.Database.open(database) as db:
        for number, (focal, (width, height)) in enumerate(
            zip(given["focals"].tolist(), given["sizes"].tolist(), strict=True), 1
        ):
            camera = pycolmap.Camera(
                camera_id=number,
                model="SIMPLE_RADIAL",
                width=width,
                height=height,
                params=[focal or FOCAL * max(width, height), width / 2, height / 2, 0.0],
            )
            camera.has_prior_focal_length = focal > 0
            db.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
        for k, (name, number) in enumerate(
            zip(given["names"].tolist(), (given["camera_of"] + 1).tolist(), strict=True), 1
        ):
            image = pycolmap.Image(name=name, camera_id=number, image_id=k)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=k, rig_id=number)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
