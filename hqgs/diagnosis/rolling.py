"""Whether rows of a photo were taken one after another while the camera moved, as a rolling shutter does.

Patches around the scene's points are laid on the photos that show them too. How far they are off is told by
what each camera's pose is off, six numbers, and by how its picture slides from the top row to the last one,
two more: those are what a rolling shutter leaves when the pose has had its share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from hqgs.base.evenly import evenly
from hqgs.diagnosis.constants import (
    ROLLING_FEWEST,
    ROLLING_LIKE,
    ROLLING_OTHERS,
    ROLLING_PATCH,
    ROLLING_PHOTOS,
    ROLLING_POINTS,
    ROLLING_RIDGE,
    ROLLING_ROUNDS,
    ROLLING_SIDE,
    ROLLING_SMOOTH,
    ROLLING_STEPS,
)
from hqgs.photos.pixels import as_floats
from hqgs.scene.geometry import project, shrunk, unproject
from hqgs.scene.scene import Camera, Scene

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RollingSigns:
    """How far pictures slide from their top row to the last one, in shares of their height."""

    slides: Floats  # [N, 2], right and down, of the photos that were looked at; of mean 0
    error: float  # root mean square of their standard errors, as `size` of the slides

    @property
    def size(self) -> float:
        return float(np.sqrt(np.square(self.slides).sum(1).mean()))


@dataclass(frozen=True)
class _Photo:
    camera: Camera
    grey: NDArray[np.float32]  # [h, w]
    rows: NDArray[np.intp]  # of the points that it shows


def rolling_signs(scene: Scene) -> RollingSigns | None:
    """Of the training photos; None where they are too few, or share too few points to tell."""
    if scene.seen is None or len(scene.train) < 3:
        return None
    views = [scene.train[k] for k in evenly(len(scene.train), ROLLING_PHOTOS)]
    photos = []
    for view in (shrunk(view, ROLLING_SIDE) for view in views):
        grey = gaussian_filter(as_floats(view.image).mean(2, dtype=np.float32), ROLLING_SMOOTH)
        rows = np.unique(np.asarray(scene.seen.get(view.name, []), np.intp))
        photos.append(_Photo(view.camera, np.asarray(grey, np.float32), rows))
    points = scene.points.astype(np.float64)
    shared = np.array([[len(_common(a, b)) for b in photos] for a in photos])
    np.fill_diagonal(shared, 0)
    pairs = list[_Pair]()
    for k, photo in enumerate(photos):
        for other in np.argsort(-shared[k], kind="stable")[:ROLLING_OTHERS].tolist():
            common = _common(photo, photos[other])
            common = common[evenly(len(common), ROLLING_POINTS)]
            if (pair := _pair((k, other), photo, photos[other], points[common])) is not None:
                pairs.append(pair)
    told = np.zeros(len(photos), np.intp)
    for pair in pairs:
        told[list(pair.numbers)] += len(pair.off)
    if told.min() < ROLLING_FEWEST:
        return None
    found, errors = (numbers[:, 6:] for numbers in _fitted(pairs, len(photos)))
    heights = np.array([[photo.camera.height] for photo in photos])
    slides = found / heights
    return RollingSigns(slides - slides.mean(0), float(np.sqrt(np.square(errors / heights).sum(1).mean())))


@dataclass(frozen=True)
class _Pair:
    """Patches of one photo as another one shows them."""

    numbers: tuple[int, int]  # of both
    off: Floats  # [M, 2], px of the first photo: from where the poses put them to where they are
    moves: Floats  # [M, 2, 16], how far each of the two photos' eight numbers takes them, px

    def less(self, found: Floats) -> Floats:
        """What the numbers [N, 8] of all photos leave of the offsets, [M, 2]."""
        return self.off - self.moves @ found[list(self.numbers)].ravel()


def _pair(numbers: tuple[int, int], photo: _Photo, other: _Photo, points: Floats) -> _Pair | None:
    """None where no patch lies well on both."""
    reach = np.arange(-ROLLING_PATCH, ROLLING_PATCH + 1.0)
    grid = np.stack([step.ravel() for step in np.meshgrid(reach, reach)], -1)  # [P, 2]
    centres, depths = project(photo.camera, points)
    pixels = centres[:, None] + grid
    flat = unproject(photo.camera, pixels.reshape(-1, 2), depths.repeat(len(grid)))
    there = project(other.camera, flat)[0].reshape(pixels.shape)
    inside = _within(photo, pixels) & _within(other, there)
    pixels, there, points = pixels[inside], there[inside], points[inside]
    if not len(points):
        return None
    template = _normed(_at(other.grey, there))
    slopes = [np.asarray(slope, np.float32) for slope in np.gradient(photo.grey)[::-1]]  # along x, y
    off = np.zeros((len(points), 2))
    like = np.zeros(len(points))
    for _ in range(ROLLING_STEPS):
        at = pixels + off[:, None]
        here = _at(photo.grey, at)
        contrast = np.linalg.norm(here - here.mean(1, keepdims=True), axis=1)[:, None] + 1e-6
        here = _normed(here)
        like = (here * template).sum(1)
        slope = np.stack([_at(image, at) / contrast for image in slopes], -1)
        slope -= slope.mean(1, keepdims=True)
        normal = np.einsum("mpi,mpj->mij", slope, slope) + 1e-6 * np.eye(2)
        step = np.linalg.solve(normal, np.einsum("mpi,mp->mi", slope, template - here)[..., None])[..., 0]
        off = (off + step.clip(-1, 1)).clip(-ROLLING_PATCH, ROLLING_PATCH)
    good = (like > ROLLING_LIKE) & (np.abs(off).max(1) < ROLLING_PATCH)
    if not good.any():
        return None
    side, last = len(reach), 2 * ROLLING_PATCH
    square = there[good].reshape(-1, side, side, 2)  # rows, columns
    across = (square[:, side // 2, -1] - square[:, side // 2, 0]) / last
    down = (square[:, -1, side // 2] - square[:, 0, side // 2]) / last
    back = np.linalg.inv(np.stack([across, down], -1))  # from px of the other photo to px of this one
    own, others = _moves(photo.camera, points[good]), _moves(other.camera, points[good])
    return _Pair(numbers, off[good], np.concatenate([own, -back @ others], -1))


def _moves(camera: Camera, points: Floats) -> Floats:
    """How far turns and moves of a camera, in px, and slides from top to bottom take points, [M, 2, 8]."""
    pixels, depths = project(camera, points)
    x, y = ((pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]).T
    near, zero = np.median(depths) / depths, np.zeros(len(points))
    row = (pixels[:, 1] - camera.height / 2) / camera.height
    right = [-x * y, 1 + x * x, -y, near, zero, -x * near, row, zero]
    down = [-1 - y * y, x * y, x, zero, near, -y * near, zero, row]
    return np.stack([np.stack(right, -1), np.stack(down, -1)], 1)


def _fitted(pairs: Sequence[_Pair], photos: int) -> tuple[Floats, Floats]:
    """Eight numbers of each photo, [N, 8], with least absolute errors, and their standard errors."""
    found, normal = np.zeros((photos, 8)), np.eye(8 * photos)
    weights, rest = [np.ones(len(pair.off)) for pair in pairs], list[Floats]()
    for _ in range(ROLLING_ROUNDS):
        normal, right = np.zeros((photos, 8, photos, 8)), np.zeros((photos, 8))
        for pair, weight in zip(pairs, weights, strict=True):
            moves = pair.moves * np.sqrt(weight)[:, None, None]
            own = np.einsum("mik,mil->kl", moves, moves).reshape(2, 8, 2, 8)
            towards = np.einsum("mik,mi->k", moves, pair.off * np.sqrt(weight)[:, None]).reshape(2, 8)
            for a, first in enumerate(pair.numbers):
                right[first] += towards[a]
                for b, second in enumerate(pair.numbers):
                    normal[first, :, second] += own[a, :, b]
        normal = normal.reshape(8 * photos, 8 * photos)
        normal[np.diag_indices_from(normal)] += ROLLING_RIDGE
        found = np.asarray(np.linalg.solve(normal, right.ravel()), np.float64).reshape(photos, 8)
        rest = [np.linalg.norm(pair.less(found), axis=1) for pair in pairs]
        usual = np.median(np.concatenate(rest)) + 1e-6
        weights = [1 / np.maximum(each / usual, 1) for each in rest]
    squares = sum(float(np.sum(w * r * r)) for w, r in zip(weights, rest, strict=True))
    count = 2 * sum(float(w.sum()) for w in weights)
    variance = squares / max(count - 8 * photos, 1)
    spread = np.asarray(np.diag(np.linalg.inv(normal)), np.float64).reshape(photos, 8)
    return found, np.sqrt(variance * spread)


def _common(a: _Photo, b: _Photo) -> NDArray[np.intp]:
    return np.intersect1d(a.rows, b.rows, assume_unique=True)


def _within(photo: _Photo, pixels: Floats) -> NDArray[np.bool_]:
    """Which patches [M, P, 2] lie in a photo."""
    size = photo.camera.width, photo.camera.height
    return np.asarray(((pixels > 1) & (pixels < np.subtract(size, 1))).all((1, 2)), bool)


def _at(image: NDArray[np.float32], pixels: Floats) -> Floats:
    """Values [M, P] of an image at pixels [M, P, 2], linear between their centres."""
    x, y = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    return map_coordinates(image, [y, x], order=1, mode="nearest").astype(np.float64)


def _normed(patches: Floats) -> Floats:
    """Patches [M, P] of mean 0 and length 1."""
    patches = patches - patches.mean(1, keepdims=True)
    return patches / (np.linalg.norm(patches, axis=1, keepdims=True) + 1e-6)
