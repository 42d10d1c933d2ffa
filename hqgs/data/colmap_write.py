"""Writing a COLMAP model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.camera import Camera, project
from hqgs.data.colmap_files import cameras_file_size, check_binary_model


def write_colmap(
    folder: Path,
    cameras: dict[str, Camera],
    points: NDArray[np.float32],
    colors: NDArray[np.uint8],
    seen: dict[str, NDArray[np.intp]] | None = None,
    reprojection_error: float = 0.0,
) -> None:
    """Write a binary model into `folder`: the camera of each photo name, points [P, 3] and colours [P, 3].

    Photos with equal intrinsics share a PINHOLE camera. The names are COLMAP's, relative to the folder of
    photos. `seen` has for each of them the rows of the points that it shows; where it shows them is not
    known, so they are written where the camera sees them. Every point gets `reprojection_error`, px, as its
    mean distance from the photos. Without `seen` the points have no tracks. Raises OSError if the files are
    not whole.
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
    ids_of_points = [
        model.add_point3D(point.astype(np.float64), pycolmap.Track(), color)
        for point, color in zip(points, colors, strict=True)
    ]
    if seen is not None:
        _add_tracks(model, cameras, points.astype(np.float64), ids_of_points, seen, reprojection_error)
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


def _add_tracks(
    model: pycolmap.Reconstruction,
    cameras: dict[str, Camera],
    points: NDArray[np.float64],
    ids: list[int],
    seen: dict[str, NDArray[np.intp]],
    reprojection_error: float,
) -> None:
    for image in model.images.values():
        camera, rows = cameras[image.name], seen.get(image.name, np.zeros(0, np.intp))
        pixels, _ = project(camera, points[rows])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        for k, row in enumerate(rows.tolist()):
            model.add_observation(ids[row], pycolmap.TrackElement(image.image_id, k))
    for point in model.points3D.values():
        point.error = reprojection_error
