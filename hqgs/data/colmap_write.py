"""Writing a COLMAP model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.camera import Camera
from hqgs.data.colmap_files import cameras_file_size, check_binary_model


def write_colmap(
    folder: Path, cameras: dict[str, Camera], points: NDArray[np.float32], colors: NDArray[np.uint8]
) -> None:
    """Write a binary model into `folder`: the camera of each photo name, points [P, 3] and colours [P, 3].

    Photos with equal intrinsics share a PINHOLE camera. The points have no tracks: a `Scene` holds none.
    The names are COLMAP's, relative to the folder of photos. Raises OSError if the files are not whole.
    """
    model = pycolmap.Reconstruction()
    ids: dict[tuple[float, ...], int] = {}
    for image_id, (name, camera) in enumerate(sorted(cameras.items()), start=1):
        params = (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])
        key = (camera.width, camera.height, *params)
        if key not in ids:
            ids[key] = len(ids) + 1
            pinhole = pycolmap.Camera(
                camera_id=ids[key], model="PINHOLE", width=camera.width, height=camera.height, params=params
            )
            model.add_camera_with_trivial_rig(pinhole)
        image = pycolmap.Image(name=name, camera_id=ids[key], image_id=image_id)
        rotation = pycolmap.Rotation3d(camera.viewmat[:3, :3])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, camera.viewmat[:3, 3]))
    for point, color in zip(points, colors, strict=True):
        model.add_point3D(point.astype(np.float64), pycolmap.Track(), color)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    # COLMAP takes no notice of a full disk.
    cameras_file = folder / "cameras.bin"
    try:
        check_binary_model(folder)
        if cameras_file.stat().st_size != cameras_file_size([4] * len(ids)):
            raise ValueError(f"{cameras_file} is damaged")
    except ValueError as error:
        raise OSError(f"cannot write the COLMAP model (is the disk full?): {error}") from error
