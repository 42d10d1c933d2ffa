"""Scenes in metres and upright: from printed tags of a known size (AprilTag 36h11, ArUco) that photos show.

OpenCV finds the tags. A square is laid through each one's corners in all photos that show it, by least
squares on pixels with seven unknowns: where it lies, how it is turned, and how long its sides are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hqgs.base.text import some
from hqgs.photos.light import to_linear
from hqgs.photos.pixels import as_floats, to_uint8
from hqgs.scene.constants import (
    ENOUGH_SHOW,
    TAG_BLUR,
    TAG_BORDER,
    TAG_CELL,
    TAG_FITS,
    TAG_LEVEL,
    TAG_SURE,
    TAG_UNLIKE,
)
from hqgs.scene.metres import with_metres
from hqgs.scene.paths import scene_up
from hqgs.scene.scene import Camera, Scene, View
from hqgs.scene.similarity import similarity

PATCH_SIDE = 1000  # px, least, of the photos in which tags are looked for

FAMILIES = ("APRILTAG_36h11", "ARUCO_ORIGINAL", "4X4_250", "5X5_250", "6X6_250")  # in this order

Floats = NDArray[np.float64]
_SQUARE = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])  # clockwise, as OpenCV's


@dataclass(frozen=True)
class Tag:
    """A tag in a scene's own frame."""

    name: str
    photos: int
    side: float  # of its square, world units
    error: float  # standard deviation of the side, as a share
    normal: Floats  # [3], unit, towards the cameras
    off: float  # px, median distance of its corners from where the photos have them


def by_tags(scene: Scene, size: float) -> Scene:
    """The scene in metres, by its tags, whose black squares are `size` metres wide; up too, where one lies.

    ValueError without OpenCV, or where no tag is seen by enough photos.
    """
    views = [*scene.train, *scene.test]
    seen = sightings(views)
    tags = [tag for name, at in seen.items() if (tag := lay(name, at, views)) is not None]
    good = [tag for tag in tags if tag.off <= TAG_FITS]
    if not good:
        why = f"{ENOUGH_SHOW} photos and more must show the same one sharply"
        if tags:
            why = f"{some([tag.name for tag in tags])} lies in several places: print each number once"
        found = f"{len(seen)} numbers in {len({k for at in seen.values() for k in at})} photos"
        raise ValueError(f"tag_size: no tag tells a size ({found}): {why}")
    weights = np.array([tag.error**-2 for tag in good])
    logs = np.log([tag.side * scene.world.unit for tag in good])
    mean = float(np.average(logs, weights=weights))
    apart = float((weights * (logs - mean) ** 2).sum()) / max(len(good) - 1, 1)  # 1 where errors are as told
    error = 1.96 * float(np.sqrt(max(1.0, apart) / weights.sum()))
    up, level = _up(scene_up(scene), good)
    lying = f"; up is square to the {len(level)} that lie level" if level else ""
    many = (
        f"the tag {good[0].name}" if len(good) == 1 else f"{len(good)} tags ({some([t.name for t in good])})"
    )
    said = f"{many} of {size:g} m, in up to {max(tag.photos for tag in good)} photos, tell the size{lying}"
    return with_metres(scene, size / float(np.exp(mean)), said, error, up)


def check_tag_size(size: float, distance: object = None) -> None:
    """ValueError for a size that can be none, beside a distance, or without OpenCV."""
    if not 0 < size < math.inf:
        raise ValueError(f"tag_size: {size:g} m; it must be more than 0")
    if distance is not None:
        raise ValueError("distance and tag_size: only one of them can tell the metre")
    _opencv()


def sightings(views: Sequence[View]) -> dict[str, dict[int, Floats]]:
    """Corners [4, 2] in px of each tag by its name and the view's number, where ENOUGH_SHOW show it."""
    cv2 = _opencv()
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    finders = {
        family: cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}")), options
        )
        for family in FAMILIES
    }
    found: dict[str, dict[int, Floats]] = {}
    for k, view in enumerate(views):
        gray = np.ascontiguousarray(to_uint8(as_floats(view.image).mean(-1, keepdims=True))[..., 0])
        larger = -(-PATCH_SIDE // max(gray.shape))
        gray = cv2.resize(gray, None, fx=larger, fy=larger, interpolation=cv2.INTER_CUBIC)
        for family, finder in finders.items():
            corners, numbers, _ = finder.detectMarkers(gray)
            for at, number in zip(corners, () if numbers is None else numbers.ravel(), strict=True):
                found.setdefault(f"{family} {number}", {})[k] = (
                    at.reshape(4, 2).astype(np.float64) + 0.5
                ) / larger
    return {name: at for name, at in sorted(found.items()) if len(at) >= ENOUGH_SHOW}


def _opencv() -> Any:
    try:
        import cv2  # here: only tags need it
    except ImportError as error:
        raise ValueError(f"tag_size needs the extra 'tags': pip install 'hqgs[tags]' ({error})") from error
    return cv2


class _Square:
    """A square, and those with other values of its seven unknowns: turn, shift in sides, log of the side."""

    def __init__(self, side: float, R: Floats, middle: Floats) -> None:
        self.side, self.R, self.middle = side, R, middle

    def moved(self, values: Floats) -> _Square:
        from scipy.spatial.transform import Rotation  # here: only tags need it

        turned = Rotation.from_rotvec(values[:3]).as_matrix() @ self.R
        return _Square(self.side * float(np.exp(values[6])), turned, self.middle + self.side * values[3:6])

    def seen(self, camera: Camera) -> Floats:
        """The homography [3, 3] from places on the square, in sides from its middle, to px of a camera."""
        plane = np.column_stack([self.side * self.R[:, :2], self.middle])
        return camera.K @ (camera.viewmat[:3, :3] @ plane + np.outer(camera.viewmat[:3, 3], [0, 0, 1]))


def _mapped(H: Floats, at: Floats) -> Floats:
    """Points [N, 2] by a homography."""
    to = at @ H[:, :2].T + H[:, 2]
    return to[:, :2] / to[:, 2:]


def lay(name: str, at: dict[int, Floats], views: Sequence[View]) -> Tag | None:
    """The square on which the tag's drawing looks as the photos do; None where there is none.

    First through its corners, then on pixels, in linear light, as light mixes at an edge: corners of coded
    values make black squares too small.
    """
    from scipy.optimize import least_squares  # here: only tags need it

    cameras = {k: views[k].camera for k in at}
    first = _through_corners(at, cameras)
    if first is None:
        return None

    def off(square: _Square) -> Floats:
        return np.concatenate([_mapped(square.seen(cameras[k]), _SQUARE[:, :2]) - at[k] for k in at])

    corners = least_squares(lambda v: off(first.moved(v)).ravel(), np.zeros(7), loss="cauchy", f_scale=1.0)
    square = first.moved(corners.x)
    left = np.linalg.norm(off(square), axis=1)
    if not np.isfinite(left).all():
        return None
    patches = [_Patch(views[k], at[k], name) for k in at]
    fine = least_squares(
        lambda v: np.concatenate([patch.off(square.moved(v)) for patch in patches]),
        np.zeros(7),
        loss="soft_l1",
        f_scale=TAG_UNLIKE,
        diff_step=1e-4,
    )
    placed = square.moved(fine.x)
    spread = np.sqrt(2 * fine.cost / max(sum(patch.pixels for patch in patches) - 7, 1))
    inverse = np.linalg.inv(fine.jac.T @ fine.jac)
    error = spread * float(np.sqrt(inverse[6, 6]))
    return Tag(name, len(at), placed.side, max(error, TAG_SURE), -placed.R[:, 2], float(np.median(left)))


def _through_corners(at: dict[int, Floats], cameras: dict[int, Camera]) -> _Square | None:
    """By linear triangulation of each corner."""
    corners = np.zeros((4, 3))
    for c in range(4):
        rows = []
        for k, pixels in at.items():
            P = cameras[k].K @ cameras[k].viewmat[:3]
            rows += [P[axis] - pixels[c, axis] * P[2] for axis in range(2)]
        point = np.linalg.svd(np.array([row / np.linalg.norm(row) for row in rows]))[2][-1]
        corners[c] = point[:3] / point[3]
    fit = similarity(_SQUARE, corners) if np.isfinite(corners).all() else None
    return None if fit is None else _Square(*fit)


class _Patch:
    """The pixels of a photo around a tag, in linear light, and the tag's drawing."""

    def __init__(self, view: View, corners: Floats, name: str) -> None:
        low = np.maximum(np.floor(corners.min(0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(corners.max(0)).astype(int) + 2, [view.camera.width, view.camera.height])
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True)))
        light = to_linear(as_floats(view.image[low[1] : high[1], low[0] : high[0]]).astype(np.float64))
        self.camera = view.camera
        self.at = np.stack([x.ravel(), y.ravel()], 1)
        self.light = light.mean(-1).ravel()
        self.drawing = _drawing(name, float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).mean()))
        self.pixels = int(np.prod(high - low))

    def off(self, square: _Square) -> Floats:
        """Photo less drawing [N], as shares of the contrast; 0 beyond its white border."""
        from scipy.ndimage import map_coordinates  # here: only tags need it

        on = _mapped(np.linalg.inv(square.seen(self.camera)).astype(np.float64), self.at)
        half = 0.5 + TAG_BORDER * 0.5
        inside = (np.abs(on) < half).all(1)
        if inside.sum() < 16:
            return np.ones(len(on))
        places = (on[inside, ::-1] + 0.5 + TAG_BORDER) / (1 + 2 * TAG_BORDER) * len(self.drawing) - 0.5
        drawn = map_coordinates(self.drawing, places.T, order=1, mode="nearest")
        basis = np.column_stack([drawn, np.ones(len(drawn))])
        gain, dark = np.linalg.lstsq(basis, self.light[inside], rcond=None)[0]
        found = np.zeros(len(on))
        found[inside] = (self.light[inside] - basis @ [gain, dark]) / max(abs(gain), 1e-3)
        return found


def _drawing(name: str, side: float) -> Floats:
    """A tag [S, S], white 1, with TAG_BORDER sides of white around, as smooth as photos show such a side."""
    from scipy.ndimage import gaussian_filter  # here: only tags need it

    cv2 = _opencv()
    family, number = name.split()
    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
    cells = codes.markerSize + 2
    drawn = cv2.aruco.generateImageMarker(codes, int(number), cells * TAG_CELL).astype(np.float64) / 255
    drawn = np.pad(drawn, round(TAG_BORDER * cells * TAG_CELL), constant_values=1.0)
    return gaussian_filter(drawn, TAG_BLUR * cells * TAG_CELL / side, mode="nearest")


def _up(before: Floats, tags: Sequence[Tag]) -> tuple[tuple[float, float, float] | None, list[Tag]]:
    """Up, square to the tags that lie level as far as cameras tell, and which do; None: none does."""
    level = [tag for tag in tags if abs(tag.normal @ before) > np.cos(np.radians(TAG_LEVEL))]
    if not level:
        return None, []
    mean = sum((tag.normal * np.sign(tag.normal @ before) / tag.error**2 for tag in level), np.zeros(3))
    x, y, z = (mean / np.linalg.norm(mean)).tolist()
    return (x, y, z), level
