"""What each format reader hands over: photos on disk with their cameras, before any pixel is decoded."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from hqgs.base.text import some
from hqgs.photos.files import MisfitError
from hqgs.photos.suffixes import PHOTO_SUFFIXES
from hqgs.scene.constants import LARGEST, MOST_SIDE
from hqgs.scene.faces import AROUND, Face
from hqgs.scene.photo_files import Named, below, masks_among
from hqgs.scene.scene import SfmReport, TrackStatistics
from hqgs.scene.world import World

LENS_SHARES = 1000  # focal lengths and principal points in sides of the photo; damaged files go far beyond
NO_POSE = np.full((4, 4), np.nan)  # of a photo that its file lists without a place


@dataclass(frozen=True)
class Photo:
    """One registered photo. `camera` may be distorted and may be declared at another size than the file's."""

    name: str
    path: Path
    camera: pycolmap.Camera
    viewmat: NDArray[np.float64]  # [4, 4], world to camera, OpenCV frame
    mask_path: Path | None = None
    film: float | None = None  # as `View.film`
    face: Face | None = None  # the part of it that is meant; its pose is `viewmat`
    mask_shown: bool = False  # whether it is of the photo as EXIF shows it, where shapes do not tell


@dataclass(frozen=True)
class Capture:
    """A scene as its files describe it."""

    source: str
    photos: list[Photo]
    downscale: float  # what is left to do on the photos' stored size
    points: NDArray[np.floating]  # [P, 3], world of the files; P may be 0
    point_colors: NDArray[np.uint8]  # [P, 3]
    folder: Path | None = None  # where every photo lies, registered or not; None: in several
    test_names: frozenset[str] | None = None  # the test views, where the format names them
    near_far: dict[str, tuple[float, float]] = field(default_factory=dict)  # depth range by photo name
    notes: list[str] = field(default_factory=list)
    world: World = field(default_factory=World)  # the frame of the files, where that is another
    tracks: TrackStatistics | None = None  # px of the cameras' own size
    seen: dict[str, NDArray[np.intp]] | None = None  # by photo, rows of the points that it shows
    sfm: SfmReport | None = None  # where cameras and points come from the photos


def no_points() -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """An empty point cloud: points [0, 3] and colours [0, 3]."""
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def keep_finite(
    points: NDArray[np.float64], colors: NDArray[np.uint8], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points without those that float32 cannot hold; how many were dropped goes to `notes`."""
    with np.errstate(over="ignore"):
        finite = np.isfinite(points.astype(np.float32)).all(1)
    if not finite.all():
        notes.append(f"{int((~finite).sum())} of {len(points)} points are NaN or Inf and were left out")
    return points[finite], colors[finite]


def viewmat_from_pose(pose: NDArray[np.float64], name: str, *, camera_to_world: bool) -> NDArray[np.float64]:
    """World-to-camera matrix [4, 4] from the first three rows [3, 4] of a pose in the OpenCV frame.

    Poses printed with few digits are a little off a rotation: the nearest rotation (polar factor) is taken.
    A camera that was scaled with its scene has no other view: its size is left out of `camera_to_world`.
    Numbers that are not finite, or all 0, say that the photo has no pose: the matrix is `NO_POSE` then.
    Raises ValueError that names the photo when the pose is too large, or no rotation.
    """
    R, t = pose[:, :3], pose[:, 3]
    if not np.isfinite(pose).all() or not R.any():
        return NO_POSE.copy()
    if not (np.abs(pose) < LARGEST).all():
        raise ValueError(f"photo {name!r}: its pose is beyond {LARGEST:g}: {pose.tolist()}")
    size = np.cbrt(np.linalg.det(R))
    if camera_to_world and size > 0:
        R = R / size
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > 1e-2 or size < 0:
        left = ", it mirrors: the frame of its camera or the world is left-handed; negate one of its axes"
        mirrored = left if size < 0 else ""
        raise ValueError(
            f"photo {name!r}: its pose holds no rotation{mirrored} (R R^T is {error:.3g} off): {R.tolist()}"
        )
    u, _, vt = np.linalg.svd(R)
    R = u @ vt
    viewmat = np.eye(4)
    viewmat[:3, :3] = R.T if camera_to_world else R
    viewmat[:3, 3] = -R.T @ t if camera_to_world else t
    return viewmat


def list_photos(folder: Path) -> list[str]:
    """Photos below `folder` as relative POSIX paths, sorted; no masks, nothing hidden, nothing of a run."""
    names = sorted(p.relative_to(folder).as_posix() for p in below(folder, PHOTO_SUFFIXES))
    masks = masks_among(names)
    return [name for name in names if name not in masks]


def inside(root: Path, name: str, what: str) -> Path:
    """`root / name`, or ValueError when that leaves `root` (a resolved path) by `..` or as an absolute path.

    Links inside the folder are followed as the user set them up: the written path is judged first, and what
    it resolves to only where that is outside.
    """
    if "\0" in name:
        raise ValueError(f"{what} {name!r} is not a file in {root}")
    path = Path(os.path.normpath(root / name))
    if not path.is_relative_to(root):
        path = path.resolve()
    if not path.is_relative_to(root):
        raise ValueError(f"{what} {name!r} is outside of the folder {root}")
    return path


def files_named(
    root: Path, names: Iterable[str], what: str, files: Named, others: Iterable[str] = ()
) -> dict[str, Path]:
    """The files inside `root` that written names mean, by name; those that are gone are not among them.

    That is the file where the name says, else the only one there up to the suffix, else what other machines
    call so (`Named.find`), if it is not that of another name, of `names` or `others`.
    ValueError where a name leaves `root`, and no file there has such a name.
    """
    names = [*names]
    exact = {name: path for name in (*names, *others) if (path := _there(root, name)) is not None}
    taken = set(exact.values())
    found = {name: exact[name] for name in names if name in exact}
    for name in names:
        if name not in found and (path := files.up_to_suffix(name)) is not None and path not in taken:
            found[name] = path
    taken |= {*found.values()}
    for name in names:
        path = found.get(name) or files.find(name, taken.__contains__)
        if path is None:
            try:
                inside(root, name.replace("\\", "/"), what)
            except ValueError:
                if (path := files.find(name)) is None:  # else the same photo, written otherwise
                    raise
        if path is not None:
            found[name] = path
    return found


def _there(root: Path, name: str) -> Path | None:
    """The file where a written name says that it is; None: there is none."""
    for option in dict.fromkeys((name, name.replace("\\", "/"))):
        with suppress(ValueError):
            path = inside(root, option, "")
            if os.path.lexists(path) and not path.is_dir():
                return path
    return None


def photo_folder(root: Path, downscale: float) -> tuple[Path, float, list[str]] | None:
    """The folder of photos to read, the downscale left to do, and notes; None when there is no such folder.

    `images_N` holds the photos scaled down by N: it is used when N is the downscale asked for. `images_1`
    stands in for `images` where only that is there (the Deblur-NeRF layout).
    """
    ready = root / f"images_{downscale:g}"
    if ready.is_dir():
        return (
            ready,
            1.0,
            [f"photos were read from {ready.name}, which has them at downscale {downscale:g}"],
        )
    spelt = [p for p in (sorted(root.iterdir()) if root.is_dir() else []) if p.name.lower() == "images"]
    for folder in (root / "images", root / "images_1", *spelt):
        if folder.is_dir():
            return folder, downscale, []
    return None


def perhaps(root: Path) -> str:
    """The folder above that has photos, where one inside of a scene was given, as advice; or nothing."""
    meant = next((folder for folder in [*root.absolute().parents][:2] if photo_folder(folder, 1.0)), None)
    return "" if meant is None else f"; did you mean {meant}?"


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
            "another aspect ratio (was the photo rotated or cropped after the cameras were computed?)"
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
