"""Bundle adjustment in which each observation is as precise as its patch, in each direction.

An edge tells where it is across, and nothing along; COLMAP counts both the same. Levenberg-Marquardt on
poses, points and, where they are free, the cameras' focal lengths and distortion, with the points eliminated
(Triggs et al., Bundle adjustment, 1999, sections 4 and 6). It imports of hqgs what needs nothing else:
`program.py` uses it in COLMAP's process.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.transform import Rotation

from hqgs.scene.sfm.refine.tracks import Floats, Tracks

ADJUST_STEPS, LEVENBERG = 10, 1e-6  # at most; damping, of the diagonal
ROBUST = 2.0  # medians of the errors, scale of Cauchy's function
ALONG = 0.1  # of the usual precision; an observation that is less precise some way follows its point there
NUDGE = 1e-6  # of a depth or parameter, by which slopes are taken
SETTLED, TINY = (
    1e-5,
    1e-12,
)  # of the cost: a step that gains less is the last; of the diagonal: what stays free


def weighted(
    model: pycolmap.Reconstruction, names: list[str], tracks: Tracks, information: Floats, free: bool
) -> tuple[Tracks, Floats]:
    """Adjust the model's photos to the observations; `information` [O, 2, 2] of each, 1 / px^2.

    `free`: the cameras' focal lengths and distortion are adjusted, too. Returns the tracks with their points
    moved, and how far off observations are [O], in deviations of what they should be. Observations stay what
    they are where they are precise, and move to their points where they tell nothing.
    """
    problem = _Problem(model, names, tracks, information, free)
    off = problem.off()
    scale = ROBUST * float(np.median(np.linalg.norm(off, axis=1)))
    damping, cost = LEVENBERG, _cost(off, scale)
    for _ in range(ADJUST_STEPS):
        before = problem.state()
        problem.step(off, scale, damping)
        moved = problem.off()
        if not (now := _cost(moved, scale)) < cost:  # also where a point came behind a photo
            problem.set(*before)
            damping *= 100
            continue
        done, off, cost, damping = cost - now < SETTLED * cost, moved, now, damping / 10
        if done:
            break
    problem.store()
    usual = float(np.sqrt(np.median(np.linalg.det(information))))
    apart = np.linalg.solve(problem.whiten, off[:, :, None])
    told = np.linalg.solve(information + ALONG * usual * np.eye(2), information @ apart)
    xy = tracks.xy + (apart - told)[:, :, 0]
    return replace(tracks, points=problem.points, xy=xy), np.linalg.norm(off, axis=1)


def _cost(off: Floats, scale: float) -> float:
    """Cauchy's function of errors [O, 2]."""
    return float(np.log1p(np.square(off).sum(1) / scale**2).sum())


class _Problem:
    """Poses, cameras and points, and what the observations say of them."""

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        names: list[str],
        tracks: Tracks,
        information: Floats,
        free: bool,
    ) -> None:
        images = {image.name: image for image in model.images.values()}
        self.images = [images[name] for name in names]
        numbers = sorted({image.camera_id for image in self.images})
        self.cameras = [model.cameras[number] for number in numbers]
        self.view, self.point, self.xy = tracks.view, tracks.point, tracks.xy
        self.camera_of = np.array([numbers.index(image.camera_id) for image in self.images])[self.view]
        self.whiten: Floats = np.swapaxes(np.linalg.cholesky(information), 1, 2).astype(np.float64)
        first = self.cameras[0]
        self.columns = [*first.focal_length_idxs(), *first.extra_params_idxs()] if free else []
        poses = [image.cam_from_world() for image in self.images]
        self.set(
            np.array([pose.rotation.matrix() for pose in poses]),
            np.array([pose.translation for pose in poses]),
            tracks.points,
            np.array([camera.params for camera in self.cameras]),
        )

    def state(self) -> tuple[Floats, Floats, Floats, Floats]:
        return self.turns, self.shifts, self.points, self.params

    def set(self, turns: Floats, shifts: Floats, points: Floats, params: Floats) -> None:
        self.turns, self.shifts, self.points, self.params = turns, shifts, points, params

    def store(self) -> None:
        """Write poses and cameras into the model."""
        for camera, params in zip(self.cameras, self.params, strict=True):
            camera.params = params
        for image, turn, shift in zip(self.images, self.turns, self.shifts, strict=True):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), shift)
            image.frame.set_cam_from_world(image.camera_id, pose)

    def _inside(self) -> Floats:
        """The points in the frames of the photos that see them [O, 3]."""
        return (
            np.einsum("oij,oj->oi", self.turns[self.view], self.points[self.point]) + self.shifts[self.view]
        )

    def _project(self, inside: Floats, params: Floats) -> Floats:
        """Where the photos see points [O, 3]; behind them nowhere."""
        found = np.full((len(inside), 2), np.inf)
        for k, (camera, values) in enumerate(zip(self.cameras, params, strict=True)):
            camera.params = values
            mine = (self.camera_of == k) & (inside[:, 2] > 0)
            found[mine] = camera.img_from_cam(inside[mine])
        return found

    def off(self) -> Floats:
        """Errors of the observations [O, 2], in deviations."""
        return np.einsum("oij,oj->oi", self.whiten, self._project(self._inside(), self.params) - self.xy)

    def _slopes(self, inside: Floats) -> tuple[Floats, Floats]:
        """How what photos see changes with points in their frames [O, 2, 3], and with cameras [O, 2, F]."""
        space = np.zeros((len(inside), 2, 3))
        for axis in range(3):
            nudge = np.zeros_like(inside)
            nudge[:, axis] = NUDGE * inside[:, 2]
            apart = self._project(inside + nudge, self.params) - self._project(inside - nudge, self.params)
            space[:, :, axis] = apart / (2 * nudge[:, axis, None])
        lens = np.zeros((len(inside), 2, len(self.columns)))
        for k, column in enumerate(self.columns):
            nudge = np.zeros_like(self.params)
            nudge[:, column] = NUDGE * np.maximum(1, np.abs(self.params[:, column]))
            apart = self._project(inside, self.params + nudge) - self._project(inside, self.params - nudge)
            lens[:, :, k] = apart / (2 * nudge[self.camera_of, column, None])
        return space, lens

    def step(self, off: Floats, scale: float, damping: float) -> None:
        """Move everything by a damped step of Gauss-Newton from where the errors are `off`."""
        inside, photos, points = self._inside(), len(self.images), len(self.points)
        own = 6 * photos + len(self.columns) * len(self.cameras)
        less = (1 / np.sqrt(1 + np.square(off).sum(1) / scale**2))[:, None, None]
        space, lens = self._slopes(inside)
        space, lens = less * self.whiten @ space, less * self.whiten @ lens
        around = np.cross((inside - self.shifts[self.view])[:, None], space)  # of a turn of the photo
        by_point = space @ self.turns[self.view]
        wrong = (less[:, :, 0] * off).ravel()

        # Rows: two of each observation. Columns: six of its photo, some of its camera; of its point three.
        at = self.camera_of[:, None] * len(self.columns) + np.arange(len(self.columns))
        at = np.concatenate([6 * self.view[:, None] + np.arange(6), 6 * photos + at], axis=1)
        values = np.concatenate([around, space, lens], axis=2)
        at = np.repeat(at[:, None], 2, axis=1)
        rows = np.arange(len(wrong) + 1) * at.shape[2]
        J = csr_array((values.ravel(), at.ravel(), rows), shape=(len(wrong), own))
        order = np.arange(len(self.point) + 1)
        G = bsr_array((by_point, self.point, order), shape=(len(wrong), 3 * points)).tocsr()
        whole, mixed = (J.T @ J).toarray(), (J.T @ G).tocsr()
        whole_points = csr_array(
            (np.ones(len(self.point)), (self.point, order[:-1])), (points, len(self.point))
        )
        blocks = whole_points @ (np.swapaxes(by_point, 1, 2) @ by_point).reshape(-1, 9)
        blocks = blocks.reshape(points, 3, 3)
        for diagonal in (np.einsum("ii->i", whole), np.einsum("pii->pi", blocks)):
            diagonal *= 1 + damping
            diagonal += TINY * diagonal.max()  # the frame as a whole is free
        inverse = bsr_array((np.linalg.inv(blocks), np.arange(points), np.arange(points + 1))).tocsr()
        out = mixed @ inverse
        if mixed.nnz > 0.1 * own * 3 * points:  # then dense products are faster
            shared = out.toarray() @ mixed.toarray().T
        else:
            shared = (out @ mixed.T).toarray()
        moves = np.linalg.solve(whole - shared, -(J.T @ wrong) + out @ (G.T @ wrong))
        back = inverse @ -(G.T @ wrong + mixed.T @ moves)

        turns, shifts = np.split(moves[: 6 * photos].reshape(photos, 6), 2, axis=1)
        params = self.params.copy()
        params[:, self.columns] += moves[6 * photos :].reshape(len(self.cameras), -1)
        turned = Rotation.from_rotvec(turns).as_matrix() @ self.turns
        self.set(turned, self.shifts + shifts, self.points + back.reshape(-1, 3), params)
