"""Whether what a file says of a camera can be one, and of which photos."""

from __future__ import annotations

import numpy as np
import pycolmap

from hqgs.base.text import some
from hqgs.photos.files import MisfitError
from hqgs.scene.capture import Capture
from hqgs.scene.constants import LENS_SHARES, MOST_SIDE
from hqgs.scene.faces import AROUND


def check_camera(camera: pycolmap.Camera, name: str) -> None:
    """Raise ValueError, naming the photo, when the camera's size or parameters cannot be a camera's."""
    if not (1 <= camera.width <= MOST_SIDE and 1 <= camera.height <= MOST_SIDE):
        raise ValueError(f"the camera of photo {name!r} has the size {camera.width} x {camera.height}")
    if camera.model.name == AROUND:
        return
    focals = camera.params[camera.focal_length_idxs()]
    if len(focals) == 0:
        raise ValueError(f"photo {name!r}: a {camera.model.name} camera has no pinhole view")
    shares = np.array([*focals, camera.principal_point_x, camera.principal_point_y])
    shares = shares / max(camera.width, camera.height)
    sound = np.isfinite(camera.params).all() and (np.abs(shares) < LENS_SHARES).all()
    if not (sound and (shares[: len(focals)] > 1 / LENS_SHARES).all()):
        raise ValueError(
            f"the camera of photo {name!r} ({camera.model.name}) has the parameters {camera.params.tolist()}"
        )


def check_size(camera: pycolmap.Camera, width: int, height: int, name: str) -> None:
    """MisfitError where a photo of `width` x `height` is no scaled version of what the camera describes."""
    if not fits(camera, width, height):
        raise MisfitError(
            f"photo {name!r} is {width} x {height}, but its camera is for {camera.width} x {camera.height}: "
            "another shape (was the photo rotated or cropped after the cameras were computed?)"
        )


def fits(camera: pycolmap.Camera, width: int, height: int) -> bool:
    """Whether the shapes agree; each side may be off by one pixel of rounding."""
    return abs(width * camera.height - height * camera.width) <= camera.width + camera.height


def odd_lenses(capture: Capture) -> list[str]:
    """That cameras have their principal point outside of their photo, in a sentence; else nothing."""
    odd = []
    for photo in capture.photos:
        camera = photo.camera
        if camera.model.name != AROUND and photo.face is None:
            x, y = camera.principal_point_x, camera.principal_point_y
            width, height = camera.width, camera.height
            if not (0 <= x <= width and 0 <= y <= height):
                odd.append(f"{photo.name} ({x:.6g}, {y:.6g} of {width} x {height} px)")
    if not odd:
        return []
    return [
        f"{len(odd)} of {len(capture.photos)} cameras have their principal point outside of the photo: are "
        f"focal length and centre those of another size than w and h? {some(odd)}"
    ]
