"""Photos that see more than a flat picture holds, as several: the faces of a cube around the camera.

A pinhole's picture grows with the tangent of the angle: at 120 degrees its rim is stretched four times, and
at 180 it would have no end. The cube's faces end at 45 degrees, and lose nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import PurePosixPath

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.ndimage import label

from hqgs.scene.constants import SHOWN, SMALLEST_SIDE

WIDE = 120.0  # degrees across or up and down that a flat picture shows at most
FACE_LATTICE = 128  # rays each way that tell which part of a face a photo shows
THETAS = 1024  # angles at which a lens is asked whether its picture still grows

AROUND = "EQUIRECTANGULAR"  # COLMAP's model of photos of 360 x 180 degrees
# rotations, face from camera: x, y and z of each face in the camera's frame (x right, y down, z forward)
CUBE: dict[str, NDArray[np.float64]] = {
    name: np.array(rows, np.float64)
    for name, rows in {
        "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
        "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
        "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
        "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
        "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    }.items()
}


@dataclass(frozen=True, eq=False)
class Face:
    """A pinhole view that a photo holds; px are those that the photo's camera declares."""

    name: str
    rotation: NDArray[np.float64]  # [3, 3], face from camera
    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3]
    limit: float  # radians from the camera's axis, beyond which its model means nothing


def around(width: int, height: int) -> pycolmap.Camera:
    """The camera of a photo of 360 x 180 degrees."""
    return pycolmap.Camera(model=AROUND, width=width, height=height, params=[width, height])


def face_name(name: str, face: str) -> str:
    """What the face of a photo is called: `walk/7.jpg` has the face `walk/7.front.jpg`."""
    path = PurePosixPath(name)
    return str(path.with_name(f"{path.stem}.{face}{path.suffix}"))


def photo_name(name: str, face: str) -> str:
    """The photo whose face is called so: of `walk/7.front.jpg`, `walk/7.jpg`; of no face, the name itself."""
    if not face:
        return name
    path = PurePosixPath(name)
    stem = path.stem.removesuffix(f".{face}")
    return str(path.with_name(stem if stem == path.stem else stem + path.suffix))


def faces_of(camera: pycolmap.Camera, finer: float = 1.0) -> tuple[Face, ...]:
    """The faces that a camera sees; none where a flat picture holds what it sees.

    A whole face has as many pixels from edge to edge as the photo has for a right angle: in its middle it is
    a little coarser than the photo, at its edges finer, where more would only be blurred. It is cut down to
    what the photo shows of it. `finer`: times as many pixels.
    """
    return _faces(camera.model.name, tuple(camera.params), camera.width, camera.height, finer)


@lru_cache(maxsize=64)
def _faces(model: str, params: tuple[float, ...], width: int, height: int, finer: float) -> tuple[Face, ...]:
    camera = pycolmap.Camera(model=model, params=params, width=width, height=height)
    if model == AROUND:
        radian, limit = width / (2 * math.pi), math.pi
    else:
        if model.endswith("PINHOLE") or not np.isfinite(params).all():
            return ()
        radian, (degrees, limit) = float(camera.focal_length_x), _sees(camera)
        if degrees < WIDE:
            return ()
    focal = finer * radian * math.pi / 4
    if (side := 2 * round(focal)) < SMALLEST_SIDE:
        return ()
    nodes = (np.arange(FACE_LATTICE) + 0.5) * (2 / FACE_LATTICE) - 1
    rays = np.stack([*np.meshgrid(nodes, nodes), np.ones((FACE_LATTICE, FACE_LATTICE))], -1)
    found = []
    for name, rotation in CUBE.items():
        shown = inside(camera, rays @ rotation, limit)
        if shown.mean() < SHOWN:
            continue
        (left, right), (top, bottom) = (_span(shown, axis, side) for axis in (0, 1))
        # A strip would have no pixels when it is scaled.
        if min(right - left, bottom - top) < max(SMALLEST_SIDE, 0.1 * side):
            continue
        K = np.array([[focal, 0, side / 2 - left], [0, focal, side / 2 - top], [0, 0, 1]])
        found.append(Face(name, rotation, right - left, bottom - top, K, limit))
    return tuple(found)


def _span(shown: NDArray[np.bool_], axis: int, side: int) -> tuple[int, int]:
    """From and to which pixel of a side the nodes [FACE_LATTICE, FACE_LATTICE] lie that show something."""
    nodes = np.flatnonzero(shown.any(axis))
    return math.floor(nodes[0] / FACE_LATTICE * side), math.ceil((nodes[-1] + 1) / FACE_LATTICE * side)


def projected(camera: pycolmap.Camera, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixel positions [..., 2] of rays [..., 3] in the camera's frame; NaN where there is none."""
    return np.asarray(camera.img_from_cam(rays.reshape(-1, 3))).reshape(*rays.shape[:-1], 2)


def inside(camera: pycolmap.Camera, rays: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
    """Which rays [..., 3] a photo shows, none of them farther than `limit` from its axis."""
    at = projected(camera, rays) / (camera.width, camera.height)
    near = np.arctan2(np.linalg.norm(rays[..., :2], axis=-1), rays[..., 2]) <= limit
    return ((at >= 0) & (at <= 1)).all(-1) & near


def _sees(camera: pycolmap.Camera) -> tuple[float, float]:
    """Degrees that a lens sees, across its middle or up and down; and the angle, radians, up to which what
    lies farther from its axis comes to lie farther from the middle of its picture.

    The polynomial of a lens may turn back beyond the angles that it was fitted to.
    """
    thetas = np.arange(THETAS) * (math.pi / 2 / THETAS)
    least, reach = math.pi / 2, []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        rays = np.stack([x * np.sin(thetas), y * np.sin(thetas), np.cos(thetas)], -1)
        radii = np.linalg.norm(projected(camera, rays) - projected(camera, rays[:1]), axis=-1)
        turned = np.flatnonzero(~(np.diff(radii) > 0))
        least = min(least, float(thetas[turned[0]])) if len(turned) else least
        reach.append(thetas[inside(camera, rays, least)].max(initial=0))
    return math.degrees(max(reach[0] + reach[1], reach[2] + reach[3])), least


def lit(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where [H, W] light fell: not the dark corners around the circle that a fisheye throws."""
    parts = np.empty(image.shape[:2], np.int32)
    label(image.max(-1) < 12, output=parts)  # of 255
    corners = parts[[0, 0, -1, -1], [0, -1, 0, -1]]
    return ~np.isin(parts, corners[corners > 0]) if corners.all() else np.ones(parts.shape, bool)
