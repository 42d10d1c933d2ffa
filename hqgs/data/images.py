"""Photos from disk to views: decode, undistort at the stored size, then downscale."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from hqgs.camera import Camera, View
from hqgs.data.capture import Photo
from hqgs.data.undistort import Pinhole, check_camera, check_size, to_pinhole

SMALLEST_SIDE = 8  # px; below this no metric or tile means anything
MAX_WORKERS = 4  # each holds a few photos at their stored size

_CAMERAS_KEPT = 2  # sampling grids kept for the next photo of the same camera; one is 8 bytes a pixel
_DECODE_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError),
    MemoryError,  # Pillow reads as many bytes as a chunk says it has
)
Pixels = NDArray[np.uint8] | NDArray[np.float32]
_CameraKey = tuple[str, tuple[float, ...], int, int, int, int]


class UnreadableError(ValueError):
    """A photo or mask that cannot be decoded; the message names the file."""


def load_views(
    photos: list[Photo], downscale: float, optional: frozenset[str] = frozenset()
) -> tuple[list[View], dict[str, UnreadableError]]:
    """Decode `photos`, in their order, as pinhole views scaled down by `downscale` (at least 1).

    Intrinsics scale with the true ratio of sizes, per axis. The second result tells, by name, why photos of
    the names in `optional` have no view: they, or their masks, cannot be decoded.

    Raises FileNotFoundError for a camera without photo, ValueError for a photo that does not fit its camera
    or gets smaller than 8 px, UnreadableError for another that cannot be decoded; each names the photo.
    """
    for photo in photos:
        if not photo.path.is_file():
            raise FileNotFoundError(f"the camera of photo {photo.name!r} has no photo: {photo.path}")
        check_camera(photo.camera, photo.name)

    @lru_cache(maxsize=_CAMERAS_KEPT)
    def pinhole(key: _CameraKey) -> Pinhole:
        model, params, camera_width, camera_height, width, height = key
        camera = pycolmap.Camera(model=model, params=params, width=camera_width, height=camera_height)
        return to_pinhole(camera, width, height)

    unreadable: dict[str, UnreadableError] = {}

    def load(photo: Photo) -> View | None:
        try:
            return _load_view(photo, downscale, pinhole)
        except UnreadableError as error:
            if photo.name not in optional:
                raise
            unreadable[photo.name] = error
            return None

    with ThreadPoolExecutor(min(MAX_WORKERS, os.cpu_count() or 1)) as pool:
        jobs = [pool.submit(load, photo) for photo in photos]
        try:
            views = [view for job in jobs if (view := job.result()) is not None]
        finally:
            pool.shutdown(cancel_futures=True)  # after an error the photos still waiting are not wanted
    return views, {photo.name: unreadable[photo.name] for photo in photos if photo.name in unreadable}


def _load_view(photo: Photo, downscale: float, pinhole: Callable[[_CameraKey], Pinhole]) -> View:
    check_size(photo.camera, *stored_size(photo.path), photo.name)
    image, mask = decode(photo.path)
    height, width = image.shape[:2]
    if photo.mask_path is not None:
        counts = decode_mask(photo.mask_path, width, height)
        mask = counts if mask is None else mask & counts

    camera = photo.camera
    key = (camera.model.name, tuple(camera.params), camera.width, camera.height, width, height)
    try:
        flat = pinhole(key)
    except ValueError as e:  # from pycolmap: the message does not say which camera
        raise ValueError(f"the camera of photo {photo.name!r} cannot be undistorted: {e}") from e
    image, mask = flat.picture(image), flat.mask(mask)

    width, height = round(flat.width / downscale), round(flat.height / downscale)
    if min(width, height) < SMALLEST_SIDE:
        raise ValueError(
            f"photo {photo.name!r} is {width} x {height} pixels after downscale {downscale:g}; "
            f"each side needs {SMALLEST_SIDE}"
        )
    image, mask = area_downscale(image, mask, width, height)
    K = np.diag([width / flat.width, height / flat.height, 1.0]) @ flat.K
    if mask is not None and mask.all():
        mask = None
    return View(photo.name, Camera(width, height, K, photo.viewmat), image, mask)


def stored_size(path: Path, what: str = "photo") -> tuple[int, int]:
    """Width and height that the photo's header promises, for a look before memory is taken for the pixels.

    Pillow refuses more than 179 million of them. Raises UnreadableError.
    """
    try:
        with Image.open(path) as photo:
            return photo.size
    except _DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the {what} {path}: {e}") from e


def decode(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The photo as uint8 RGB [H, W, 3], and its mask [H, W] (alpha >= 128) where it is not opaque everywhere.

    Greyscale becomes three equal channels, 16 bits become 8. Colours are as stored: nothing is composited,
    no colour profile is applied. EXIF orientation is not applied either: the cameras were computed for the
    pixels as stored, and a turned photo would no longer fit them. Raises UnreadableError.
    """
    try:
        with Image.open(path) as photo:
            if photo.mode == "F":
                raise ValueError("floating-point pixels have no agreed white")
            if photo.mode.startswith("I"):
                grey = np.asarray(photo).astype(np.int64)  # 16 bits; older Pillow calls the mode "I"
                if grey.min() < 0 or grey.max() > 65535:
                    raise ValueError(f"pixel values {grey.min()}..{grey.max()} are not 16 bit")
                return np.repeat(((grey + 128) // 257).astype(np.uint8)[..., None], 3, -1), None
            if photo.has_transparency_data:
                rgba = np.array(photo.convert("RGBA"))
                opaque = bool((rgba[..., 3] == 255).all())
                return np.ascontiguousarray(rgba[..., :3]), None if opaque else rgba[..., 3] >= 128
            return np.array(photo.convert("RGB")), None
    except _DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the photo {path}: {e}") from e


def decode_mask(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """The mask file as [height, width], True where it is not zero; the nearest pixel at another size."""
    w, h = stored_size(path, "mask")
    if abs(w * height - h * width) > width + height:
        raise ValueError(f"the mask {path} is {w} x {h}, its photo {width} x {height}: another shape")
    try:
        with Image.open(path) as file:
            pixels = np.asarray(file.convert("RGB") if file.mode == "P" else file)
    except _DECODE_ERRORS as e:
        raise UnreadableError(f"cannot read the mask {path}: {e}") from e
    if pixels.ndim == 3:
        pixels = pixels[..., :3].max(-1)  # without alpha, which says nothing here
    rows = ((np.arange(height) + 0.5) * h / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * w / width).astype(np.int64)
    return pixels[rows][:, columns] != 0


def area_downscale(
    image: Pixels, mask: NDArray[np.bool_] | None, width: int, height: int
) -> tuple[Pixels, NDArray[np.bool_] | None]:
    """Mean over each new pixel's area in the old photo; parts of old pixels count by their share.

    With a mask, only what counts enters the mean (hidden colours must not bleed over the edge), and the new
    pixel counts where at least half of its area does. Not Pillow's BOX filter: that takes old pixels whole or
    not at all, which moves the picture by up to half a pixel at factors that are not whole.
    """
    if image.shape[:2] == (height, width):
        return image, mask
    area = image.shape[0] * image.shape[1] / (height * width)
    if mask is None:
        return _as(image, _area_sum(image, height, width) / area), None
    share = _area_sum(mask.astype(np.uint8), height, width)
    visible = _area_sum(np.where(mask[..., None], image, 0), height, width)
    hidden = _area_sum(np.where(mask[..., None], 0, image), height, width)
    seen = share > 1e-6 * area
    mean = np.where(seen[..., None], visible / np.where(seen, share, 1.0)[..., None], hidden / area)
    return _as(image, mean), share >= 0.5 * area


def _as(image: Pixels, values: NDArray[np.float64]) -> Pixels:
    """The values as the image's type; whole numbers are rounded."""
    if image.dtype == np.uint8:
        return np.rint(values).clip(0, 255).astype(np.uint8)
    return values.astype(np.float32)


def _area_sum(image: Pixels | NDArray[np.uint8], height: int, width: int) -> NDArray[np.float64]:
    """Sums over the new pixels' areas, [height, width, ...]. Whole numbers stay exact at whole factors."""
    return _sum_rows(_sum_rows(image, height).swapaxes(0, 1), width).swapaxes(0, 1)


def _sum_rows(
    a: NDArray[np.uint8] | NDArray[np.float32] | NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Merge the rows of `a` into `count` equal stretches by differences of the running sum."""
    total = np.uint32 if a.dtype == np.uint8 else np.float64  # 255 * MAX_SIDE fits into 32 bits
    running = np.zeros((len(a) + 1, *a.shape[1:]), total)
    np.cumsum(a, axis=0, dtype=total, out=running[1:])
    edges = np.arange(count + 1) * len(a) / count
    below = np.minimum(edges.astype(np.int64), len(a) - 1)
    part = (edges - below).reshape(-1, *[1] * (a.ndim - 1))
    at_edges = running[below] + part * (running[below + 1] - running[below])
    return np.diff(at_edges, axis=0)
