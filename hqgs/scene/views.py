"""Photos from disk to views: decode, undistort, downscale.

A photo that is scaled down is decoded and undistorted at about twice the wanted size, not at its stored one:
the mean over an area of 2 x 2 and more hides what that loses, and takes a fraction of the time and memory.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import groupby
from threading import Lock

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from hqgs.base.machine import AT_ONCE, give_back_memory, keep_large_arrays_apart
from hqgs.base.stages import OnStage, Stage, silent
from hqgs.base.threads import of_each
from hqgs.photos.exif import read_exif
from hqgs.photos.files import UnreadableError, decode, decode_mask, shrunk, stored_size
from hqgs.photos.pixels import oriented
from hqgs.photos.resize import CUBIC_RADIUS, Pixels, area_downscale
from hqgs.scene.capture import Photo, check_camera, check_size, fits
from hqgs.scene.constants import MAX_WORKERS, SMALLEST_SIDE
from hqgs.scene.faces import AROUND, CUBE, Face, faces_of, lit, projected
from hqgs.scene.geometry import parts_of
from hqgs.scene.scene import Camera, View

# px of such a grid: positions are computed so far apart; px: where that is exact enough, and a camera that is
# no farther from a pinhole is one, its photo not resampled.
LATTICE, EXACT = 8, 0.02
# Pixels of the photo between samples: where they are farther apart, means come first; and at which it may be
# decoded: 6000 px go to 1600 by way of 3000.
FAR_SAMPLES, DENSE_SAMPLES = 1.25, 1.75

_CameraKey = tuple[str, tuple[float, ...], int, int, int, int, str]


def load_views(
    photos: list[Photo],
    downscale: float,
    optional: frozenset[str] = frozenset(),
    on_stage: OnStage = silent,
    over: tuple[float, float, float] | None = None,
) -> tuple[list[View], dict[str, UnreadableError]]:
    """Decode `photos`, in their order, as pinhole views scaled down by `downscale` (at least 1).

    Intrinsics scale with the true ratio of sizes, per axis. The second result tells, by name, why photos of
    the names in `optional` have no view: they, or their masks, cannot be decoded. `on_stage` hears each.
    No more than MAX_WORKERS photos are in memory at more than the wanted size. A photo whose faces follow
    each other is decoded once for all of them.

    `over`: what shows where photos are transparent, in place of a mask (`decode`).

    Raises FileNotFoundError for a camera without photo, ValueError for a photo that does not fit its camera
    or gets smaller than 8 px, UnreadableError for another that cannot be decoded; each names the photo.
    """
    for photo in photos:
        if not photo.path.is_file():
            raise FileNotFoundError(f"the camera of photo {photo.name!r} has no photo: {photo.path}")
        check_camera(photo.camera, photo.name)

    keep_large_arrays_apart()

    # Kept for the next photos of the same camera; a grid takes 8 bytes a pixel.
    @lru_cache(maxsize=len(CUBE) if any(photo.face for photo in photos) else 2)
    def made(key: _CameraKey) -> Pinhole:
        model, params, camera_width, camera_height, width, height, name = key
        camera = pycolmap.Camera(model=model, params=params, width=camera_width, height=camera_height)
        face = next((face for face in faces_of(camera) if face.name == name), None)
        # With two new pixels for a wanted one along each side.
        return to_pinhole(camera, width, height, max(downscale / 2.0, 1.0), face)

    locks: defaultdict[_CameraKey, Lock] = defaultdict(Lock)

    def pinhole(key: _CameraKey) -> Pinhole:
        with locks[key]:  # photos of one camera begin together, and one of them makes the grid for all
            return made(key)

    unreadable: dict[str, UnreadableError] = {}
    shown = any(_only_as_shown(photo) for photo in photos if photo.face is None)

    def load(faces: list[Photo]) -> list[View]:
        views, decoded = list[View](), None
        for photo in faces:
            try:
                decoded = decoded or _decoded(photo, downscale, over, shown)
                views.append(_view(photo, decoded, downscale, pinhole, over is not None))
            except UnreadableError as error:
                if photo.name not in optional:
                    raise
                unreadable[photo.name] = error
        return views

    groups = [list(faces) for _, faces in groupby(photos, lambda photo: (photo.path, id(photo.camera)))]
    views, done = list[View](), 0
    for k, (faces, loaded) in enumerate(zip(groups, of_each(load, groups, MAX_WORKERS), strict=True)):
        views += loaded
        done += len(faces)
        on_stage(Stage("photos read", done, len(photos)))
        if (k + 1) % 10 == 0 or done == len(photos):
            give_back_memory()
    return views, {photo.name: unreadable[photo.name] for photo in photos if photo.name in unreadable}


@dataclass
class _Decoded:
    """A photo, for the views that are made of it."""

    image: Pixels  # [H, W, 3], of a cut-out photo with a fourth channel
    mask: NDArray[np.bool_] | None  # [H, W]
    stored: tuple[int, int]  # width and height of the file
    size: tuple[float, float]  # width and height of the photo in pixels of `image`
    turns: int
    device: str
    kept: dict[tuple[int, int], tuple[Pixels, NDArray[np.bool_] | None]] = field(default_factory=dict)

    def coarser(self, width: int, height: int) -> tuple[Pixels, NDArray[np.bool_] | None]:
        """Means over so many areas, kept for the next face."""
        if (width, height) not in self.kept:
            self.kept[width, height] = area_downscale(self.image, self.mask, width, height, self.size)
        return self.kept[width, height]


def _only_as_shown(photo: Photo) -> bool:
    """Whether it fits its camera only if it is turned as EXIF says."""
    if not read_exif(photo.path).quarter_turns % 2:
        return False
    width, height = stored_size(photo.path)
    return not fits(photo.camera, width, height) and fits(photo.camera, height, width)


def _decoded(
    photo: Photo, downscale: float, over: tuple[float, float, float] | None, others_shown: bool
) -> _Decoded:
    """`others_shown`: whether there are photos of the capture that fit only as EXIF shows them."""
    camera, stored = photo.camera, stored_size(photo.path)
    exif = read_exif(photo.path)
    turns, shown = exif.quarter_turns, 1
    turned = (stored[1], stored[0]) if turns % 2 else stored
    if fits(camera, *turned) and (others_shown or not fits(camera, *stored)):
        # the cameras are those of photos as EXIF shows them
        stored, turns, shown = turned, 0, exif.orientation
    check_size(camera, *stored, photo.name)
    # A mask hides colours that must not be mixed into what it shows: such photos are decoded whole.
    enough = downscale > 1 and photo.mask_path is None
    least = (
        math.ceil(DENSE_SAMPLES * stored[0] / downscale),
        math.ceil(DENSE_SAMPLES * stored[1] / downscale),
    )
    least = least if shown == 1 else (least[1], least[0])
    image, mask = decode(photo.path, least if enough else None, over)
    if photo.mask_path is not None:
        height, width = image.shape[:2]
        counts = decode_mask(photo.mask_path, width, height, exif.orientation, photo.mask_shown)
        mask = counts if mask is None else mask & counts
    if shown != 1:
        image = oriented(image, shown)
        mask = None if mask is None else oriented(mask, shown)
    height, width = image.shape[:2]
    if photo.face is not None and camera.model.name != AROUND and not (light := lit(image[..., :3])).all():
        mask = light if mask is None else mask & light
    alike = f"{camera.model.name} {camera.params.tolist()} {stored[0]} x {stored[1]}"
    size = stored[0] / shrunk(stored[0], width), stored[1] / shrunk(stored[1], height)
    return _Decoded(image, mask, stored, size, turns, " ".join(exif.camera) or alike)


def _view(
    photo: Photo, decoded: _Decoded, downscale: float, pinhole: Callable[[_CameraKey], Pinhole], cut_out: bool
) -> View:
    camera, stored = photo.camera, decoded.stored
    image, mask, size = decoded.image, decoded.mask, decoded.size
    face = "" if photo.face is None else photo.face.name
    key = (camera.model.name, tuple(camera.params), camera.width, camera.height, *stored, face)
    try:
        flat = pinhole(key)
    except ValueError as e:  # from pycolmap: the message does not say which camera
        raise ValueError(f"the camera of photo {photo.name!r} cannot be undistorted: {e}") from e
    width, height = round(flat.width / downscale), round(flat.height / downscale)
    if min(width, height) < SMALLEST_SIDE:
        raise UnreadableError(
            f"photo {photo.name!r} is {width} x {height} pixels after downscale {downscale:g}; "
            f"each side needs {SMALLEST_SIDE}"
        )
    if flat.grid is not None:
        columns = flat.grid.shape[2]
        apart = flat.width / columns * size[0] / stored[0]  # pixels of the photo from one sample to the next
        if apart > FAR_SAMPLES:
            w, h = (max(1, round(side / apart)) for side in size)
            (image, mask), size = decoded.coarser(w, h), (w, h)
        image, mask = flat.picture(image, size), flat.mask(mask)
        size = None
    image, mask = area_downscale(image, mask, width, height, size)
    K = np.diag([width / flat.width, height / flat.height, 1.0]) @ flat.K
    if mask is not None and mask.all():
        mask = None
    camera_now = Camera(width, height, K, photo.viewmat)
    # Until then a smaller frame shows as much of the film's codec as at its own size.
    film = photo.film if downscale <= 1.5 else None
    image, empty = parts_of(image) if cut_out else (image, None)
    return View(photo.name, camera_now, image, mask, None, decoded.turns, film, decoded.device, face, empty)


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera and, where the photo needs resampling, how to get its picture from the stored one."""

    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3]
    grid: torch.Tensor | None  # [1, h, w, 2] float32, sampling positions; None: keep the photo
    inside: NDArray[np.bool_] | None  # [h, w], True where the position lies in the photo
    around: bool = False  # the photo's last column goes on in its first

    def picture(self, image: Pixels, size: tuple[float, float] | None = None) -> Pixels:
        """Resample `image` [H, W, C] by bicubic interpolation, clamped at the border; [h, w, C], uint8 again.

        Bicubic, not bilinear, which would soften a sharp photo. `size`: width and height of the photo in
        pixels of `image`, where it ends within the last ones; None: it fills them.
        """
        if self.grid is None:
            return image
        grid, (height, width) = self.grid, image.shape[:2]
        if size is not None and size != (width, height):
            grid = (grid + 1) * torch.tensor([size[0] / width, size[1] / height]) - 1
        pixels = torch.from_numpy(image)
        if self.around:
            seam = CUBIC_RADIUS  # columns beyond both ends that the interpolation reads
            pixels = torch.cat([pixels[:, -seam:], pixels, pixels[:, :seam]], 1)
            grid = grid * torch.tensor([width / (width + 2 * seam), 1.0])
        channels = pixels.permute(2, 0, 1)[None].float()
        out = torch.nn.functional.grid_sample(
            channels, grid, mode="bicubic", padding_mode="border", align_corners=False
        )
        return out[0].round_().clamp_(0, 255).byte().permute(1, 2, 0).contiguous().numpy()

    def mask(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        """Resample `mask` [H, W] (None: everywhere): a pixel counts where all that it is made of counts."""
        if self.grid is None or self.inside is None:
            return mask
        if mask is None:
            return None if self.inside.all() else self.inside
        # A bicubic sample reads 4 x 4 pixels: what is hidden grows by one pixel before the 2 x 2 sampling.
        hidden = torch.from_numpy(~mask)[None, None].float()
        hidden = torch.nn.functional.max_pool2d(hidden, 3, stride=1, padding=1)
        out = torch.nn.functional.grid_sample(
            hidden, self.grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        return (out[0, 0] < 1e-3).numpy() & self.inside


def to_pinhole(
    camera: pycolmap.Camera, width: int, height: int, coarser: float = 1.0, face: Face | None = None
) -> Pinhole:
    """The pinhole view of a photo of `width` x `height` taken with `camera`, whatever size that declares.

    The new camera is pycolmap's `undistort_camera` with no blank pixels (focal lengths kept, size chosen so
    that the picture is filled; where extreme distortion prevents that, `inside` is False). Pixel centres are
    at half-integers in COLMAP, in `grid_sample(align_corners=False)` and here. The grid has the sides of the
    new camera divided by `coarser` (at least 1). Raises ValueError when nothing of the photo would remain or
    pycolmap cannot undistort the camera.
    """
    sx, sy = width / camera.width, height / camera.height
    if face is None:
        K = camera.calibration_matrix()
        if _is_straight(camera, K):
            return Pinhole(width, height, np.diag([sx, sy, 1.0]) @ K, None, None)
        flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(blank_pixels=0.0), camera)
        if not (1 <= flat.width <= 4 * camera.width and 1 <= flat.height <= 4 * camera.height):
            raise ValueError(f"{camera.model.name} camera undistorts to {flat.width} x {flat.height} pixels")
        K = flat.calibration_matrix()
    else:
        flat, K = face, face.K
    w, h = max(1, round(flat.width * sx)), max(1, round(flat.height * sy))
    K = np.diag([w / flat.width, h / flat.height, 1.0]) @ K

    rows, columns = max(1, round(h / coarser)), max(1, round(w / coarser))
    ys, xs = (np.arange(rows) + 0.5) * (h / rows), (np.arange(columns) + 0.5) * (w / columns)
    shares = partial(_shares, camera, K, face)
    guessed = _interpolated(shares, xs, ys) if coarser > 1 else None
    grid = np.empty((rows, columns, 2), np.float32)
    inside = np.empty((rows, columns), np.bool_)
    step = max(1, AT_ONCE // columns)
    for top in range(0, rows, step):
        band = slice(top, top + step)
        at = shares(xs, ys[band]) if guessed is None else guessed[band]
        inside[band] = ((at >= 0) & (at <= 1)).all(-1)
        grid[band] = 2 * np.nan_to_num(at, nan=0.5, posinf=2, neginf=-1).clip(-1, 2) - 1
    if not inside.any():
        raise ValueError(
            f"{camera.model.name} with parameters {camera.params.tolist()} shows nothing of the photo"
        )
    return Pinhole(w, h, K, torch.from_numpy(grid)[None], inside, camera.model.name == AROUND)


def _shares(
    camera: pycolmap.Camera,
    K: NDArray[np.float64],
    face: Face | None,
    xs: NDArray[np.floating],
    ys: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Where the pixels of the pinhole camera `K` at columns `xs` and rows `ys` lie in the stored photo,
    [rows, columns, 2], as shares of its size, so that the declared size drops out."""
    rays = _rays(K, np.stack(np.meshgrid(xs, ys), -1))
    if face is not None:
        rays = rays @ face.rotation
        far = np.arctan2(np.linalg.norm(rays[..., :2], axis=-1), rays[..., 2]) > face.limit
        rays[far] = np.nan
    return projected(camera, rays) / (camera.width, camera.height)


def _interpolated(
    shares: Callable[..., NDArray[np.float64]], xs: NDArray[np.floating], ys: NDArray[np.floating]
) -> NDArray[np.float32] | None:
    """`shares` from every LATTICE-th column and row, bilinear between them; None where that is not exact to
    EXACT px of the grid in the middle of each cell."""
    x, y = (np.linspace(side[0], side[-1], math.ceil(len(side) / LATTICE) + 1) for side in (xs, ys))
    known = shares(x, y)
    true = shares(x[:-1] + np.diff(x) / 2, y[:-1] + np.diff(y) / 2)
    middle = (known[1:, 1:] + known[1:, :-1] + known[:-1, 1:] + known[:-1, :-1]) / 4
    if not (np.abs(middle - true) * (len(xs), len(ys)) < EXACT).all():
        return None
    channels = torch.from_numpy(known).permute(2, 0, 1)[None].float()
    size = (len(ys), len(xs))
    return (
        torch.nn.functional.interpolate(channels, size, mode="bilinear", align_corners=True)[0]
        .permute(1, 2, 0)
        .numpy()
    )


def _rays(K: NDArray[np.float64], pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Viewing directions [..., 3] of pixel positions [..., 2]; their z is 1."""
    directions = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    return np.concatenate([directions, np.ones_like(directions[..., :1])], -1)


def _is_straight(camera: pycolmap.Camera, K: NDArray[np.float64]) -> bool:
    """Whether the model maps like a pinhole, tested on a lattice over the photo, border included.

    Not asked of `is_undistorted()`: that says yes to a fisheye whose coefficients are zero.
    """
    xs = np.linspace(0, camera.width, 33)
    ys = np.linspace(0, camera.height, 33)
    pixels = np.stack(np.meshgrid(xs, ys), -1)
    moved = projected(camera, _rays(K, pixels)) - pixels
    return bool(np.abs(moved).max() < EXACT)
