"""The similarity that takes one reconstruction's frame to another's, from the cameras that both have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hqgs.scene.constants import ROUNDING
from hqgs.scene.sfm.constants import ALIGN_ROUNDS, FARTHEST, HUBER
from hqgs.scene.similarity import Rows, robust, similarity

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
        raise ValueError(f"the {count} cameras of a frame have one centre, which leaves its scale open")
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


@dataclass(frozen=True)
class Observations:
    """Where photos see points: photo `camera[k]` has point `point[k]` at `pixels[k]`."""

    camera: NDArray[np.intp]  # [O]
    point: NDArray[np.intp]  # [O]
    pixels: Floats  # [O, 2], x and y


def refine(
    start: Similarity, points: Floats, seen: Observations, Ks: Floats, viewmats: Floats
) -> tuple[Similarity, Floats]:
    """The similarity under which cameras see another frame's points [P, 3] where their photos saw them.

    By centres alone a frame whose cameras lie close together, compared with what they look at, can be turned
    by a degree: the errors of centres and orientations go together so that the pictures stay the same. What
    counts for other cameras of the target frame is the pictures. Gauss-Newton on the distances in pixels with
    Huber's weights, from `start`. `Ks` [V, 3, 3] and `viewmats` [V, 4, 4] are the target's cameras. Also
    returns the distances [O], px; infinite where a camera has the point behind it.
    """
    best = start
    apart, cost = _distances(start, points, seen, Ks, viewmats)
    damping = 1e-6
    for _ in range(ALIGN_ROUNDS):
        step = _gauss_newton(best, points, seen, Ks, viewmats, damping)
        now, now_cost = _distances(step, points, seen, Ks, viewmats)
        if now_cost < cost:
            done = now_cost > cost * (1 - 1e-9)
            best, apart, cost, damping = step, now, now_cost, damping / 10
            if done:
                break
        else:
            damping *= 100
    return best, apart


def _view(
    similarity: Similarity, points: Floats, seen: Observations, viewmats: Floats
) -> tuple[Floats, Floats]:
    """Each observation's point, moved: from the centroid [O, 3], and in its camera's frame [O, 3]."""
    moved = similarity.points(points)
    arms = (moved - moved.mean(0))[seen.point]
    R, t = viewmats[seen.camera, :3, :3], viewmats[seen.camera, :3, 3]
    return arms, np.einsum("nij,nj->ni", R, moved[seen.point]) + t


def _distances(
    similarity: Similarity, points: Floats, seen: Observations, Ks: Floats, viewmats: Floats
) -> tuple[Floats, float]:
    """Distances [O] in px and their mean Huber cost."""
    _, p = _view(similarity, points, seen, viewmats)
    front = p[:, 2] > 0
    p = np.where(front[:, None], p, 1.0)
    pixels = np.einsum("nij,nj->ni", Ks[seen.camera, :2], p / p[:, 2:])
    apart = np.where(front, np.linalg.norm(pixels - seen.pixels, axis=1), np.inf)
    huber = np.where(apart <= HUBER, apart**2 / 2, HUBER * (np.minimum(apart, FARTHEST) - HUBER / 2))
    return apart, float(huber.mean())


def _gauss_newton(
    similarity: Similarity,
    points: Floats,
    seen: Observations,
    Ks: Floats,
    viewmats: Floats,
    damping: float,
) -> Similarity:
    """One step in the turn and the logarithm of the scale about the points' centroid, and in the shift."""
    arms, p = _view(similarity, points, seen, viewmats)
    front = p[:, 2] > 0
    p = np.where(front[:, None], p, 1.0)
    K, R = Ks[seen.camera], viewmats[seen.camera, :3, :3]
    off = np.einsum("nij,nj->ni", K[:, :2], p / p[:, 2:]) - seen.pixels
    apart = np.linalg.norm(off, axis=1)
    weights = np.where(front & (apart < FARTHEST), np.minimum(1, HUBER / np.maximum(apart, ROUNDING)), 0)
    project = np.zeros((len(p), 2, 3))  # d pixel / d camera frame
    project[:, 0, 0], project[:, 1, 1] = K[:, 0, 0] / p[:, 2], K[:, 1, 1] / p[:, 2]
    project[:, 0, 2] = -project[:, 0, 0] * p[:, 0] / p[:, 2]
    project[:, 1, 2] = -project[:, 1, 1] * p[:, 1] / p[:, 2]
    turns = np.cross(np.eye(3)[None], arms[:, None]).swapaxes(1, 2)  # columns: axis x arm
    moves = np.concatenate([turns, arms[:, :, None], np.tile(np.eye(3), (len(p), 1, 1))], axis=2)
    J = np.einsum("nij,njk,nkl->nil", project, R, moves)
    normal = np.einsum("n,nij,nik->jk", weights, J, J)
    slope = np.einsum("n,nij,ni->j", weights, J, off)
    step = -np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), slope, rcond=None)[0]
    turn, grow = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(np.clip(step[3], -1, 1)))
    center = similarity.points(points).mean(0)
    return Similarity(
        grow * similarity.scale,
        turn @ similarity.R,
        grow * turn @ (similarity.t - center) + center + step[4:],
    )
