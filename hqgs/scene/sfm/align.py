"""The similarity that takes one reconstruction's frame to another's, from the cameras that both have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hqgs.scene.constants import ROUNDING
from hqgs.scene.sfm.refine.tracks import Tracks
from hqgs.scene.similarity import Rows, robust, similarity

HUBER, FARTHEST = 1.0, 1e3  # px from where on a distance counts linearly, and no more

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """x -> scale R x + t."""

    scale: float
    R: Floats  # [3, 3], a rotation
    t: Floats  # [3]

    def points(self, x: Floats) -> Floats:
        """Points [N, 3] in the other frame."""
        return self.scale * x @ self.R.T + self.t

    def viewmats(self, viewmats: Floats) -> Floats:
        """World-to-camera matrices [V, 4, 4] of the same cameras in the other frame, rotations again."""
        moved = np.tile(np.eye(4), (len(viewmats), 1, 1))
        moved[:, :3, :3] = viewmats[:, :3, :3] @ self.R.T
        moved[:, :3, 3] = -np.einsum("nij,nj->ni", moved[:, :3, :3], self.points(camera_centers(viewmats)))
        return moved


def camera_centers(viewmats: Floats) -> Floats:
    """Centres [V, 3] of world-to-camera matrices [V, 4, 4]."""
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def rotation_angles(R: Floats) -> Floats:
    """Angles [V] of rotations [V, 3, 3], radians; also exact for small ones."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(R - np.eye(3), axis=(1, 2)) / 8**0.5, 0, 1))


def align(source: Floats, target: Floats) -> tuple[Similarity, NDArray[np.bool_]]:
    """The similarity from the frame of `source` to that of `target`, world-to-camera matrices [V, 4, 4].

    Least squares over the camera centres (Umeyama 1991), in which the orientations count a little, so that
    cameras in a line, or two, are enough. Cameras that do not fit are left out (`robust`, from pairs). Also
    returns which do, [V].

    ValueError for fewer than two cameras, or where all centres of a frame are one point.
    """
    count = len(source)
    if count < 2:
        raise ValueError(f"two frames are aligned by at least 2 cameras, got {count}")
    centers = camera_centers(source), camera_centers(target)
    turns = np.einsum("nji,njk->nik", target[:, :3, :3], source[:, :3, :3])
    spread = float(np.sqrt(np.square(centers[1] - centers[1].mean(0)).sum(1).mean()))

    def fit(chosen: Rows) -> Similarity | None:
        found = similarity(centers[0][chosen], centers[1][chosen], turns[chosen])
        return None if found is None else Similarity(*found)

    def residuals(one: Similarity) -> Floats:
        """[V] without unit: distance of the centres in spreads, with the angle between the orientations."""
        apart = np.linalg.norm(one.points(centers[0]) - centers[1], axis=1) / spread
        return np.hypot(apart, rotation_angles(one.R.T @ turns))

    found = robust(count, 2, fit, residuals)
    if found is None:
        raise ValueError(f"the {count} cameras of a frame have one centre, so that its scale is unknown")
    return found


def pose_auc(found: Floats, own: Floats, photos: int, limits: Sequence[float] = (1, 3, 5)) -> list[float]:
    """Area under the curve of pairs whose relative pose is right to so many degrees, for each limit.

    `found` and `own` [V, 4, 4] are world-to-camera matrices of the same photos, in frames of their own;
    `photos` counts those that have no place as well: each of their pairs is a failure. A pair's error is the
    larger of the angles between its two relative rotations and between the two directions from one centre to
    the other. 1: all pairs are exact.
    """
    pairs = photos * (photos - 1) // 2
    first, second = np.triu_indices(len(found), 1)
    turns, ways = [], []
    for viewmats in (found, own):
        R, centers = viewmats[:, :3, :3], camera_centers(viewmats)
        turns.append(np.einsum("nij,nkj->nik", R[first], R[second]))
        way = np.einsum("nij,nj->ni", R[first], centers[second] - centers[first])
        ways.append(way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), ROUNDING**2))
    turned = rotation_angles(np.einsum("nij,nkj->nik", *turns))
    apart = 2 * np.arcsin(np.clip(np.linalg.norm(ways[0] - ways[1], axis=1) / 2, 0, 1))
    errors = np.rad2deg(np.maximum(turned, apart))
    return [float(np.maximum(1 - errors / limit, 0).sum() / max(pairs, 1)) for limit in limits]


def refine(start: Similarity, seen: Tracks, Ks: Floats, viewmats: Floats) -> tuple[Similarity, Floats]:
    """The similarity under which cameras see the points of another frame where their photos saw them.

    By centres alone a frame whose cameras lie close together, compared with what they look at, can be turned
    by a degree: the errors of centres and orientations go together so that the pictures stay the same. What
    counts for other cameras of the target frame is the pictures: distances in pixels, by Huber's loss along
    either axis, from `start`. `Ks` [V, 3, 3] and `viewmats` [V, 4, 4] are the target's cameras. Also
    returns the distances [O], px; infinite where a camera has the point behind it.
    """
    center = start.points(seen.points).mean(0)
    R, t, K = viewmats[seen.view, :3, :3], viewmats[seen.view, :3, 3], Ks[seen.view, :2]

    def moved(by: Floats) -> Similarity:
        """By a turn and the logarithm of a scale about the points' centroid, and a shift, [7]."""
        turn, grow = Rotation.from_rotvec(by[:3]).as_matrix(), float(np.exp(np.clip(by[3], -1, 1)))
        shift = grow * turn @ (start.t - center) + center + by[4:]
        return Similarity(grow * start.scale, turn @ start.R, shift)

    def off(by: Floats) -> Floats:
        """[O, 2], px; infinite behind the camera."""
        p = np.einsum("nij,nj->ni", R, moved(by).points(seen.points)[seen.point]) + t
        front = p[:, 2:] > 0
        pixels = np.einsum("nij,nj->ni", K, p / np.where(front, p[:, 2:], 1))
        return np.where(front, pixels - seen.xy, np.inf)

    found = least_squares(
        lambda by: off(by).clip(-FARTHEST, FARTHEST).ravel(),
        np.zeros(7),
        x_scale="jac",
        loss="huber",
        f_scale=HUBER,
        ftol=1e-12,
        xtol=1e-12,
        gtol=1e-12,
    )
    return moved(found.x), np.linalg.norm(off(found.x), axis=1)
