"""The frame in which a scene is trained: one for all units, turns and places of its files.

Its axes are those of the first training camera, its origin the middle of the cameras, its unit goes by the
scene's size. A similarity of the files changes none of that but by rounding, and rounding is taken out by
grids: the same photos give the same bits, wherever a reconstruction put its origin. What comes out of a run
is in the frame of the scene that was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from hqgs.base.elementary import on_grid
from hqgs.model.formats.turned import mapped
from hqgs.model.gaussians import Gaussians
from hqgs.scene.axes import unseen
from hqgs.scene.constants import USUAL
from hqgs.scene.known_points import with_first_points
from hqgs.scene.scene import Scene, View
from hqgs.scene.world import World, middle_and_size

# Steps to which coordinates are rounded, where a scene has the size USUAL. Rounding of the files, below 1e-10
# of that, crosses one once in many thousand points; 5e-7 of a turn are 1e-3 px at a focal length of 2,000 px.
# All poses in training are rounded to CAMERA_GRID: far above what two makes of BLAS differ by.
POSE_GRID, POINT_GRID, CAMERA_GRID = 2.0**-20, 2.0**-16, 2.0**-30

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """Coordinates of the scene that was given are `unit * x @ axes + middle` of those in training."""

    given: Scene
    axes: Array  # [3, 3], rows: this frame's axes in the given one
    unit: float
    middle: Array  # [3], in the given frame

    @classmethod
    def of(cls, scene: Scene) -> Frame:
        """ValueError where the scene has no training view, or none of them shows a point."""
        scene.check_trainable()
        scene = with_first_points(scene)
        unseen(scene.name, scene.train, scene.points)
        axes = scene.train[0].camera.viewmat[:3, :3]
        centers = np.stack([view.camera.center for view in scene.train])
        middle, size = middle_and_size(_turned(centers, axes), _turned(scene.points, axes))
        return cls(scene, axes, size / USUAL if size > 0 else 1.0, _turned(middle[None], axes.T)[0])

    def scene(self) -> Scene:
        """The scene in this frame: what is trained."""
        points = _turned(self.given.points - self.middle, self.axes) / self.unit
        rounded = on_grid(points, POINT_GRID).astype(np.float32)
        train, test = ([self._into(view) for view in views] for views in (self.given.train, self.given.test))
        return replace(self.given, train=train, test=test, points=rounded, world=World())

    def outward(self, scene: Scene) -> Scene:
        """What is left of `scene()`, where it was given: the same cameras and points to the last bit."""
        given = self.given
        train, test = _with_cameras(scene.train, given.train), _with_cameras(scene.test, given.test)
        return replace(scene, train=train, test=test, points=given.points, world=given.world)

    def gaussians(self, trained: Gaussians) -> Gaussians:
        """Gaussians of this frame in the one that was given."""
        arrays = mapped(trained.arrays(), self.unit * self.axes.T, self.middle)
        made = trained.like(
            {name: torch.from_numpy(arrays[name]).to(tensor) for name, tensor in trained.named().items()}
        )
        made.world = self.given.world
        return made

    def _into(self, view: View) -> View:
        given, viewmat = view.camera.viewmat, np.eye(4)
        R = _turned(given[:3, :3], self.axes)
        t = (_turned(self.middle[None], given[:3, :3])[0] + given[:3, 3]) / self.unit
        u, _, vt = np.linalg.svd(on_grid(R, POSE_GRID))
        viewmat[:3, :3], viewmat[:3, 3] = u @ vt, on_grid(t, POSE_GRID)
        return replace(view, camera=replace(view.camera, viewmat=viewmat))


def with_rounded_poses(scene: Scene) -> Scene:
    """The scene with poses, moved by less than 1e-9, that are alike on every make of CPU."""
    train, test = (
        [replace(v, camera=replace(v.camera, viewmat=on_grid(v.camera.viewmat, CAMERA_GRID))) for v in views]
        for views in (scene.train, scene.test)
    )
    return replace(scene, train=train, test=test)


Trainable = Scene | Frame  # as its coordinates are, or in a frame of its own


def _with_cameras(views: Sequence[View], given: Sequence[View]) -> list[View]:
    """Those of the given views that are left, in their order; names of held-out ones may be alike."""
    kept = {view.name for view in views}
    cameras = (view.camera for view in given if view.name in kept)
    return [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]


def _turned(points: NDArray[np.floating], axes: Array) -> Array:
    """Points [N, 3] along `axes`; in one order of sums, whatever the number of threads."""
    return np.einsum("nj,ij->ni", points.astype(np.float64), axes)
