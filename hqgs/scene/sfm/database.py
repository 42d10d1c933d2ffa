"""COLMAP's database before anything is found: photos, and their cameras.

It imports of hqgs what needs nothing else: `program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hqgs.scene.sfm.constants import FOCAL


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
        for number, (focal, size) in enumerate(_known(given), 1):
            camera = _camera(number, "SIMPLE_RADIAL", size, focal or FOCAL * max(size), 0.0)
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


def rigs(given: dict[str, Any], database: Path) -> None:
    """A database with the faces of photos of all around: one rig for each size of them, its sensors turned by
    `rotations` [F, 3, 3], which map the first one's frame into theirs; a frame for the F faces of each photo.
    """
    rotations = given["rotations"]
    faces = len(rotations)
    with pycolmap.Database.open(database) as db:
        for number, (focal, size) in enumerate(_known(given)):
            rig = pycolmap.Rig(rig_id=number + 1)
            for k, rotation in enumerate(rotations):
                camera = _camera(number * faces + k + 1, "SIMPLE_PINHOLE", size, focal)
                camera.has_prior_focal_length = True
                db.write_camera(camera, use_camera_id=True)
                if k == 0:
                    rig.add_ref_sensor(camera.sensor_id)
                else:
                    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3))
                    rig.add_sensor(camera.sensor_id, turned)
            db.write_rig(rig, use_rig_id=True)
        names, camera_of = given["names"].tolist(), given["camera_of"].tolist()
        for start in range(0, len(names), faces):
            number = camera_of[start]
            frame = pycolmap.Frame(frame_id=start // faces + 1, rig_id=number + 1)
            for k in range(faces):
                image = pycolmap.Image(
                    name=names[start + k], camera_id=number * faces + k + 1, image_id=start + k + 1
                )
                db.write_image(image, use_image_id=True)
                frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)


def _known(given: dict[str, Any]) -> list[tuple[float, tuple[int, int]]]:
    """Focal length in px, 0 where it is not known, and size of each camera."""
    return list(zip(given["focals"].tolist(), given["sizes"].tolist(), strict=True))


def _camera(
    number: int, model: str, size: tuple[int, int], focal: float, *distortion: float
) -> pycolmap.Camera:
    width, height = size
    params = [focal, width / 2, height / 2, *distortion]
    return pycolmap.Camera(camera_id=number, model=model, width=width, height=height, params=params)
